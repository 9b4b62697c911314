"""Every stage of the package meets its requirements: the suites that plugins subclass, run over the registry."""

from illumgrid import registry, testing

SUITES = {
    "sampler": testing.SamplerTests,
    "backend": testing.BackendTests,
    "interpolator": testing.InterpolatorTests,
}
# Too slow for these: test_oracle_chain holds it to the paths of `numba`, and test_analytic to the closed forms.
LEFT_OUT = {"reference": ("test_error_bars_are_honest", "test_light_is_as_its_closed_forms_say")}

for entry in registry.entries():
    if entry.package == "illumgrid" and entry.missing() is None:
        name = f"Test{entry.stage.__name__}"
        slow = {"paths": 1 << 11, **dict.fromkeys(LEFT_OUT[entry.name])} if entry.name in LEFT_OUT else {}
        globals()[name] = type(name, (SUITES[entry.kind],), {"stage": entry.stage, **slow})
