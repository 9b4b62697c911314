"""Every stage that the package brings keeps its promises: the suites that plugins subclass, over the registry."""

from illumgrid import registry, testing

SUITES = {
    "sampler": testing.SamplerTests,
    "backend": testing.BackendTests,
    "interpolator": testing.InterpolatorTests,
}
SLOW = {"reference": {"paths": 1 << 11, "cases": ()}}  # test_analytic holds it against the closed forms

for entry in registry.entries():
    if entry.package == "illumgrid" and entry.missing() is None:
        name = f"Test{entry.stage.__name__}"
        globals()[name] = type(name, (SUITES[entry.kind],), {"stage": entry.stage, **SLOW.get(entry.name, {})})
