"""Every stage of the package meets its requirements: the suites that plugins subclass, run over the registry."""

from illumgrid import registry, testing

SUITES = {
    "sampler": testing.SamplerTests,
    "backend": testing.BackendTests,
    "interpolator": testing.InterpolatorTests,
}
CLOSED_FORMS = {"test_light_is_as_its_closed_forms_say": None}  # test_analytic asks as many paths of these for the same
CHANGED = {
    # Too slow for its bars: test_oracle_chain holds it to the paths of `numba`.
    "reference": {"paths": 1 << 11, "test_error_bars_are_honest": None, **CLOSED_FORMS},
    "embree": CLOSED_FORMS,
}

for entry in registry.entries():
    if entry.package == "illumgrid" and entry.missing() is None:
        name = f"Test{entry.stage.__name__}"
        globals()[name] = type(name, (SUITES[entry.kind],), {"stage": entry.stage, **CHANGED.get(entry.name, {})})
