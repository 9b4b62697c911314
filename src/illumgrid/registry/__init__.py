"""Stages by name: those of the package itself and those of other packages.

Only this layer and higher ones use names; lower layers receive objects.
"""

import difflib
import importlib
import inspect
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import cache
from importlib.metadata import entry_points, version
from typing import Any, NamedTuple, cast, get_type_hints

import pluggy

from illumgrid import stages
from illumgrid.errors import BadInput, tell
from illumgrid.registry import options
from illumgrid.stages import Backend, Interpolator, Sampler
from illumgrid.transport.stages import CONTRACT, OLDEST_CONTRACT, Capabilities, capabilities

OWN = (
    "samplers.direct",
    "samplers.uniform",
    "samplers.adaptive",
    "backends.numba_",
    "backends.embree",
    "backends.reference",
    "interpolators.nearest",
    "interpolators.bilateral",
    "interpolators.splat",
    "interpolators.rbf",
)
"""Modules with stages of the package itself, each with hooks like the module of a plugin. A new stage adds one line."""

SWITCH = "ILLUMGRID_DISABLE_PLUGINS"
"""Environment variable that disables plugins: 1 for all, or names of packages joined by commas."""


def auto_backend() -> str:
    """Name of the backend that ``auto`` selects."""
    return "numba"


WHY_AUTO = "it marches level sets, so that none needs a mesh, and walked more paths a second than embree when measured"
"""Why `auto_backend` says so: ``benchmarks/paths.py``."""


class Kind(NamedTuple):
    """A kind of stage: the hook that returns its classes, and its method with the arguments of `call` (with self)."""

    hook: str
    method: str
    call: Callable[[inspect.Signature], inspect.BoundArguments]


def _filled(signature: inspect.Signature) -> inspect.BoundArguments:
    try:
        return signature.bind(0, "samples", "nodes")
    except TypeError:  # as plugins were written before there were Nodes
        return signature.bind(0, "samples", "spec", "field")


KINDS = {
    "sampler": Kind("register_samplers", "queries", lambda s: s.bind(0, "scene", "specs", "seed")),
    "backend": Kind(
        "register_backends", "solve", lambda s: s.bind(0, "scene", "queries", paths=range(1), bounces=0, seed=0)
    ),
    "interpolator": Kind("register_interpolators", "fill", _filled),
}


@dataclass(frozen=True)
class Entry:
    """A registered stage.

    Parameters
    ----------
    kind : str
        "sampler", "backend" or "interpolator".
    name : str
    stage : type
        A frozen dataclass.
    package, version : str
        Its origin.
    """

    kind: str
    name: str
    stage: type[Any]
    package: str
    version: str

    @property
    def contract(self) -> int:
        """Version of the contract that the stage was written for; 1 if it does not say."""
        return int(getattr(self.stage, "contract", 1))

    def missing(self) -> str | None:
        """None if the stage can run here, otherwise the remedy."""
        ask = getattr(self.stage, "available", lambda: None)
        try:
            return cast(str | None, ask())
        except Exception as error:
            return f"repair {self.package}, whose answer was {_described(error)}"


@dataclass(frozen=True)
class _Plugin:
    """A module with hooks: how to load it, and its origin."""

    module: str
    load: Callable[[], Any]
    package: str
    version: str

    def __str__(self) -> str:
        return f"{self.package} {self.version} ({self.module})"


def _described(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}" if str(error) else type(error).__name__


def _package_key(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name.strip()).lower()


def _plugins(switch: str) -> Iterator[_Plugin]:
    """Own stages first, then every entry point of the group that is not disabled; nothing is imported yet."""
    for name in OWN:
        module = f"illumgrid.{name}"
        yield _Plugin(module, lambda m=module: importlib.import_module(m), "illumgrid", version("illumgrid"))  # type: ignore[misc]
    off = {_package_key(name) for name in switch.split(",")}
    for entry in sorted(entry_points(group="illumgrid"), key=lambda e: (e.dist.name if e.dist else "", e.name)):
        package = entry.dist.name if entry.dist else entry.name
        if "1" not in off and _package_key(package) not in off:
            yield _Plugin(entry.value, entry.load, package, entry.dist.version if entry.dist else "unknown")


def _fault(kind: str, stage: Any) -> str | None:
    """Reason why this is not a stage of this kind; None if it is one."""
    what = getattr(stage, "__name__", repr(stage))
    name = getattr(stage, "name", None)
    method = getattr(stage, KINDS[kind].method, None)
    if not isinstance(stage, type):
        return f"{what} is not a class; expected a {kind} class (without the parentheses)"
    if not (is_dataclass(stage) and cast(Any, stage).__dataclass_params__.frozen):
        return f"{what} is not a frozen dataclass; expected @dataclass(frozen=True) above the class"
    if not (isinstance(name, str) and re.fullmatch(r"[A-Za-z0-9][\w-]*", name)) or name == "auto":
        return f"{what}.name is {name!r}; expected a word of letters, digits, - and _ other than auto"
    written_for = getattr(stage, "contract", 1)
    if not isinstance(written_for, int) or isinstance(written_for, bool):
        return f"{what}.contract is {written_for!r}; expected a version, such as {CONTRACT}"
    if not OLDEST_CONTRACT <= written_for <= CONTRACT:
        todo = "upgrade illumgrid" if written_for > CONTRACT else "upgrade the plugin"
        return (
            f"{what} was written for contract {written_for}; expected {OLDEST_CONTRACT} to {CONTRACT}, "
            f"which this version of illumgrid runs; {todo}"
        )
    if not callable(method):
        return f"{what} has no method {KINDS[kind].method}; expected that of a {kind}"
    try:
        KINDS[kind].call(inspect.signature(method))
    except TypeError:
        return f"{what}.{KINDS[kind].method} takes {inspect.signature(method)}; expected the arguments of a {kind}"
    if kind == "backend":
        try:
            capabilities(stage)
        except BadInput as fault:
            return str(fault)
    kinds = get_type_hints(stage)
    for f in fields(stage):
        if f.default is MISSING or options.expected(kinds[f.name]) is None:
            return (
                f"the option {f.name} of {what} is of type {kinds[f.name]}"
                f"{' and has no default' if f.default is MISSING else ''}; "
                "expected a bool, int, float, str, Literal of words or tuple of numbers, with a default"
            )
    return None


@dataclass(frozen=True)
class _Registry:
    """All stages that were found, and a sentence on each fault."""

    entries: tuple[Entry, ...]
    faults: tuple[str, ...]


def _hooked(plugin: _Plugin) -> Iterator[tuple[str, Any]]:
    """Kind and class of each stage that the hooks of a plugin return; for a fault, a text instead of a class."""
    manager = pluggy.PluginManager("illumgrid")
    manager.add_hookspecs(stages)
    hooks = {kind.hook: name for name, kind in KINDS.items()}
    try:
        module = plugin.load()
        manager.register(module, plugin.module)
    except (Exception, SystemExit) as error:
        yield "", f"it could not be loaded ({_described(error)})"
        return
    callers = manager.get_hookcallers(module) or []
    if not callers:
        yield "", f"it has no hooks; expected a function marked @hookimpl and named one of {', '.join(hooks)}"
    for caller in callers:
        if caller.name not in hooks:
            close = difflib.get_close_matches(caller.name, hooks, 1, 0.0)
            yield "", f"it has a hook {caller.name!r}, which there is not; did you mean {close[0]!r}?"
            continue
        try:
            for implementation in caller.get_hookimpls():
                yield from ((hooks[caller.name], stage) for stage in cast(Any, implementation.function()))
        except (Exception, SystemExit) as error:
            yield "", f"its hook {caller.name} failed ({_described(error)})"


@cache
def _registry(switch: str) -> _Registry:
    """Load the plugins one by one, so that a broken one is named and does not affect others."""
    entries: list[Entry] = []
    faults: list[str] = []
    for plugin in _plugins(switch):
        for kind, found in _hooked(plugin):
            try:
                fault = _fault(kind, found) if kind else found
            except Exception as error:  # such as a type that cannot be looked up
                fault = f"{found!r} cannot be examined ({_described(error)})"
            if fault:
                faults.append(f"the plugin {plugin} cannot be used in full: {fault}")
            elif all((e.kind, e.stage) != (kind, found) for e in entries):
                entries.append(Entry(kind, found.name, found, plugin.package, plugin.version))
    for entry in entries:
        rivals = [e for e in entries if (e.kind, e.name) == (entry.kind, entry.name)]
        if len(rivals) > 1 and rivals[0] is entry:
            faults.append(f"{_claim(rivals)}; a run that asks for {entry.name!r} is refused")
    return _Registry(tuple(entries), tuple(faults))


def _claim(rivals: Sequence[Entry]) -> str:
    return f"the {rivals[0].kind} {rivals[0].name!r} is claimed by " + " and by ".join(
        f"{e.package} {e.version} ({e.stage.__module__})" for e in rivals
    )


_reported: set[str] = set()


def entries() -> tuple[Entry, ...]:
    """Every registered stage.

    Warns
    -----
    IllumgridWarning
        Once per process, for each broken plugin and each name that two packages claim.
    """
    found = _registry(os.environ.get(SWITCH, ""))
    for fault in found.faults:
        if fault not in _reported:
            _reported.add(fault)
            tell("plugin", fault, stacklevel=2)
    return found.entries


def entry(kind: str, name: str) -> Entry:
    """The stage of this kind ("sampler", "backend", "interpolator") and name.

    Raises
    ------
    BadInput
        If the name is unknown (the message suggests the closest one), or claimed by two packages.
    """
    known = [e for e in entries() if e.kind == kind]
    wanted = auto_backend() if (kind, name) == ("backend", "auto") else name
    claims = [e for e in known if e.name == wanted]
    if not claims:
        names = list(dict.fromkeys(["auto"] * (kind == "backend") + [e.name for e in known]))
        close = difflib.get_close_matches(name, names, 1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise BadInput(f"no {kind} is named {name!r}; expected one of {', '.join(names)}{hint}")
    if len(claims) > 1:
        foreign = next((e.package for e in claims if e.package != "illumgrid"), "1")
        raise BadInput(f"{_claim(claims)}; uninstall one, or switch it off by {SWITCH}={foreign}")
    return claims[0]


def option_names(kind: str, name: str) -> list[str]:
    """Options of the stage of this kind and name."""
    return [option.name for option in options.options(entry(kind, name).stage)]


def make(kind: str, name: str, values: dict[str, Any]) -> Any:
    """Stage of this kind and name; values of options may be texts, which are parsed by the type of the stage's field.

    Raises
    ------
    BadInput
        On an unknown name or option, a value of the wrong type, or a stage that cannot run here.
    """
    found = entry(kind, name)
    types = {option.name: option.type for option in options.options(found.stage)}
    for option in values:
        if option not in types:
            close = difflib.get_close_matches(option, types, 1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            known = ", ".join(types) or "none: it has no options"
            raise BadInput(f"the {kind} {name!r} has no option {option!r}; expected one of {known}{hint}")
    if (cure := found.missing()) is not None:
        raise BadInput(f"the {kind} {name!r} cannot run here; to make it available: {cure}")
    parsed = {option: options.parse(f"{kind}.{option}", value, types[option]) for option, value in values.items()}
    try:
        return found.stage(**parsed)
    except BadInput:
        raise
    except ValueError as error:
        raise BadInput(f"the {kind} {name!r} does not take {parsed}: {error}") from error


def sampler(name: str, **options: Any) -> Sampler:
    """Sampler by name: ``sampler("uniform", count=64)``."""
    return cast(Sampler, make("sampler", name, options))


def backend(name: str, **options: Any) -> Backend:
    """Light-transport backend by name: ``backend("numba", threads=1)``."""
    return cast(Backend, make("backend", name, options))


def interpolator(name: str, **options: Any) -> Interpolator:
    """Interpolator by name: ``interpolator("nearest")``."""
    return cast(Interpolator, make("interpolator", name, options))


def available(kind: str) -> Iterator[Any]:
    """Every stage of a kind that can run here, with its default options."""
    for found in entries():
        if found.kind == kind and found.missing() is None:
            try:
                yield make(kind, found.name, {})
            except (BadInput, ImportError):  # two packages claim the name, or something is missing after all
                continue


def backends() -> Iterator[tuple[str, Backend, Capabilities]]:
    """Every backend that can run here with its default options, once per surface: "numba:mesh", "embree"."""
    for stage in available("backend"):
        for surface in capabilities(stage).variants:
            chosen = replace(stage, surface=surface)
            yield f"{stage.name}:{surface}", chosen, capabilities(chosen)
        if not capabilities(stage).variants:
            yield stage.name, stage, capabilities(stage)
