"""Registry of components: the names that the command line, TOML files, `resume` and the contract tests use.

    @unrender.register
    @dataclass(frozen=True)
    class Charbonnier:
        \"\"\"A loss: it has `value` and `derivative`.\"\"\"

A package announces its components by an entry point of the group `unrender.components` whose module registers them on import:

    [project.entry-points."unrender.components"]
    charbonnier = "my_package.losses"

The modules of `unrender` are imported at the first look-up of their kind, and entry points at the first look-up of any name. The name of
a module in a file never imports it.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.metadata
import importlib.util
import logging
import math
import pkgutil
import re
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, overload

from unrender.core.errors import InputError
from unrender.core.text import did_you_mean, in_words

GROUP = "unrender.components"
"""The entry-point group."""

_log = logging.getLogger("unrender")
_C = TypeVar("_C", bound=type)


@dataclass(frozen=True)
class Kind:
    """A kind of component.

    Attributes:
        name: name in messages and in `register(kind=)`.
        package: package whose modules define the components of `unrender`; "" if there is none.
        protocol: "module.Name" of the protocol that a class may inherit from to declare its kind.
        members: sets of methods that identify classes without that base; empty if they must inherit from the protocol.
        in_tables: whether a table {type = "Name", ...} can describe one; its keys are the fields of a frozen dataclass.
    """

    name: str
    package: str
    protocol: str
    members: tuple[frozenset[str], ...] = ()
    in_tables: bool = True


def _kind(name: str, package: str, protocol: str, *members: str, in_tables: bool = True) -> Kind:
    return Kind(name, package, protocol, tuple(frozenset(each.split()) for each in members), in_tables)


KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        _kind("loss", "unrender.losses", "unrender.losses.pixelwise.Loss", "value derivative"),
        _kind("schedule", "unrender.schedules", "unrender.schedules.Schedule", "__call__"),
        _kind("parameterisation", "unrender.parameterisations", "unrender.parameterisations.Parameterisation", "transform"),
        _kind("preconditioner", "unrender.preconditioners", "unrender.preconditioners.base.Preconditioner", "check apply"),
        _kind("pixel sampler", "unrender.pixels", "unrender.pixels.base.PixelSampler", "init draw observe"),
        _kind("image estimator", "unrender.images", "unrender.images.base.ImageEstimator", "init estimate advance"),
        _kind("estimator", "unrender.estimators", "unrender.estimators.base.Estimator", "provides init estimate"),
        _kind("optimizer", "unrender.optimizers", "unrender.optimizers.base.Optimizer", "requires init update"),
        _kind("step transform", "unrender.optimizers.transforms", "unrender.optimizers.transforms.base.StepTransform"),
        _kind("method", "unrender.methods", "unrender.methods.base.Options", in_tables=False),
        _kind(
            "gallery problem", "unrender.gallery", "unrender.gallery.specification.Specification",
            "scene parameters", "problem", in_tables=False,
        ),
    )
}  # fmt: skip
"""Every kind of component by name."""


@dataclass(frozen=True)
class Component:
    """A registered class, its kind, a key of `KINDS`, and its place in lists; components without one follow, by name."""

    name: str
    kind: str
    made_by: type
    position: float = math.inf


_components: dict[tuple[str, str], Component] = {}
"""Components by (namespace, name). All kinds that occur in tables share one namespace; each other kind has its own."""

_DECLARED = re.compile(r'^@register\(name="([\w-]+)", position=(\d+)\)', re.MULTILINE)
_state_modules: set[str] = set()
_loaded: set[str] = set()
_lock = threading.RLock()


@overload
def register(component: _C, /) -> _C: ...


@overload
def register(
    *, name: str | None = None, kind: str | None = None, states: str | None = None, position: float | None = None
) -> Callable[[_C], _C]: ...


def register(
    component: Any = None,
    /,
    *,
    name: str | None = None,
    kind: str | None = None,
    states: str | None = None,
    position: float | None = None,
) -> Any:
    """Register a class as a component. Use as a decorator above `@dataclass(frozen=True)`.

    Args:
        name: name of the component. None takes the class's name; methods and gallery problems use lower case with hyphens (`TwoPlanets` is
            "two-planets").
        kind: key of `registry.KINDS`. None takes the kind of the protocol that the class inherits from or implements.
        states: module that defines its states, if not its own. Checkpoints restore frozen dataclasses from these modules only.
        position: sort key in lists, ascending. None sorts last, by name.

    Raises:
        InputError: the kind is unknown or ambiguous; the class is not a frozen dataclass but its kind occurs in tables; another component
            has this name.
    """
    if component is None:
        return lambda made_by: _add(made_by, name, kind, states, position)
    return _add(component, name, kind, states, position)


def names(kind: str) -> list[str]:
    """Return the names of `components(kind)`, in their order. Raises `InputError` for an unknown kind.

    Names of methods and gallery problems are read from the source, because the import of their modules takes a second. Other packages
    must be imported.
    """
    of, known = _check_kind(kind), any(each.kind == kind for each in _components.values())
    imported = known or of.in_tables or importlib.metadata.entry_points(group=GROUP)
    spec = None if imported else importlib.util.find_spec(of.package)
    folders = (spec and spec.submodule_search_locations) or ()
    texts = [path.read_text("utf-8") for folder in folders for path in Path(folder).glob("*.py")]
    declared = [match for text in texts for match in _DECLARED.findall(text)]
    in_order = sorted((int(position), name) for name, position in declared)
    return [name for _, name in in_order] or list(components(kind))


def components(kind: str) -> dict[str, type]:
    """Return {name: class} of the components of a kind, sorted by position. Raises `InputError` for an unknown kind."""
    _check_kind(kind)
    _load(kind)
    members = [each for each in _components.values() if each.kind == kind]
    return {each.name: each.made_by for each in sorted(members, key=lambda each: (each.position, each.name))}


def table_components() -> dict[str, type]:
    """Return {name: class} of the components of all kinds that a table {type = "Name", ...} can describe."""
    return {
        name: made_by for kind in KINDS.values() if kind.in_tables for name, made_by in components(kind.name).items()
    }


def check_name(kind: str, name: str) -> None:
    """Raise `InputError` that suggests the nearest known name if there is no component of this kind and name."""
    known = names(kind)
    if name not in known:
        hint = did_you_mean(name, known) or f"; there are {', '.join(known)}"
        raise InputError(f"unknown {kind} {name}{hint}")


def find(kind: str, name: str) -> type:
    """Return the component of this kind and name. Raises `InputError` that suggests the nearest known name."""
    check_name(kind, name)
    return components(kind)[name]


def component_of(made_by: type) -> Component | None:
    """Return the registration of a class, or None."""
    return next((each for each in _components.values() if each.made_by is made_by), None)


def kind_of_protocol(protocol: Any) -> str | None:
    """Return the kind of a protocol, such as "loss" for `losses.Loss`, or None."""
    path = f"{getattr(protocol, '__module__', '')}.{getattr(protocol, '__qualname__', '')}"
    return next((kind.name for kind in KINDS.values() if kind.protocol == path), None)


def implements(value: Any, kind: str) -> bool:
    """Return whether an object, no class, has the methods of the components of a kind."""
    sets = () if isinstance(value, type) else KINDS[kind].members
    return any(all(hasattr(value, member) for member in members) for members in sets)


def state_modules() -> frozenset[str]:
    """Return the modules whose frozen dataclasses a checkpoint may restore: those of the registered components."""
    _load_entry_points()
    return frozenset(_state_modules)


def _add(made_by: Any, name: str | None, kind: str | None, states: str | None, position: float | None) -> Any:
    if not isinstance(made_by, type):
        raise InputError(f"register: expected a class, got {in_words(made_by)}")
    where = f"{made_by.__module__}.{made_by.__qualname__}"
    chosen = _detect(made_by, where) if kind is None else _check_kind(kind)
    parameters: Any = getattr(made_by, "__dataclass_params__", None)
    if chosen.in_tables and not (dataclasses.is_dataclass(made_by) and parameters.frozen):
        raise InputError(
            f"register: {where}: a component is a frozen dataclass; put @register above @dataclass(frozen=True)"
        )
    if not chosen.members and chosen.protocol not in _bases(made_by):
        raise InputError(f"register: {where}: a {chosen.name} inherits from {chosen.protocol}")
    hyphenated = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", made_by.__name__).lower()
    called = name or (made_by.__name__ if chosen.in_tables else hyphenated)
    space = "table" if chosen.in_tables else chosen.name
    with _lock:
        known = _components.get((space, called))
        # A class may register again: a module is reloaded, or a notebook's cell is run twice.
        if known is not None and (known.made_by.__module__, known.made_by.__qualname__) != (
            made_by.__module__, made_by.__qualname__,
        ):  # fmt: skip
            raise InputError(
                f"two components are called {called}: a {known.kind} of {known.made_by.__module__} and a {chosen.name} of "
                f"{made_by.__module__}; register one of them by another name: @register(name=...)"
            )
        if dataclasses.is_dataclass(made_by):
            _explain_unknown_arguments(made_by)
        _components[space, called] = Component(called, chosen.name, made_by, math.inf if position is None else position)
        _state_modules.update({made_by.__module__, states or made_by.__module__})
    return made_by


def _explain_unknown_arguments(made_by: type) -> None:
    """Make the constructor raise `InputError` for an unknown keyword argument, with the nearest known name."""
    original: Any = made_by.__dict__.get("__init__")
    if original is None or hasattr(original, "__wrapped__"):
        return
    known = [field.name for field in dataclasses.fields(made_by) if field.init]

    @functools.wraps(original)
    def construct(self: Any, *arguments: Any, **named: Any) -> None:
        for name in named:
            if name not in known:
                hint = did_you_mean(name, known) or (f"; it has {', '.join(known)}" if known else "; it has none")
                raise InputError(f"{made_by.__name__} has no option {name}{hint}")
        original(self, *arguments, **named)

    made_by.__init__ = construct


def _check_kind(kind: str) -> Kind:
    if not isinstance(kind, str) or kind not in KINDS:
        hint = did_you_mean(str(kind), KINDS) or f"; there are {', '.join(KINDS)}"
        raise InputError(f"register: no kind {kind!r}{hint}")
    return KINDS[kind]


def _detect(made_by: type, where: str) -> Kind:
    """Return the kind of the protocol that a class inherits from, else the kind with the largest set of methods that it implements."""
    bases = _bases(made_by)
    if declared := [kind for kind in KINDS.values() if kind.protocol in bases]:
        return declared[0]
    has = frozenset(dir(made_by))
    sizes = {name: max((len(m) for m in kind.members if m <= has), default=0) for name, kind in KINDS.items()}
    best = [name for name, size in sizes.items() if size and size == max(sizes.values())]
    if len(best) != 1:
        about = f"it may be a {' or a '.join(best)}" if best else "it has the methods of none"
        raise InputError(f"register: {where}: {about}; say which with kind=, of {', '.join(KINDS)}")
    return KINDS[best[0]]


def _bases(made_by: type) -> frozenset[str]:
    return frozenset(f"{base.__module__}.{base.__qualname__}" for base in made_by.__mro__)


def _load(kind: str) -> None:
    """Import the modules of `unrender` that define components of this kind, then entry points. Does so once."""
    package = KINDS[kind].package
    with _lock:
        if package and package not in _loaded:
            _loaded.add(package)
            try:
                home = importlib.import_module(package)
                for module in pkgutil.iter_modules(getattr(home, "__path__", ()), f"{package}."):
                    importlib.import_module(module.name)
            except BaseException:
                _loaded.discard(package)
                raise
        _load_entry_points()


def _load_entry_points() -> None:
    """Import the entry points of other packages. One that fails is skipped with a warning."""
    with _lock:
        if GROUP in _loaded:
            return
        _loaded.add(GROUP)
        for point in importlib.metadata.entry_points(group=GROUP):
            try:
                point.load()
            except KeyboardInterrupt:
                raise
            except BaseException as error:  # a third-party module may raise anything
                # Remove the components of a module whose import failed; modules that it imported successfully keep theirs.
                for key in [key for key, each in _components.items() if each.made_by.__module__ not in sys.modules]:
                    del _components[key]
                words = " ".join(str(error).split())[:200]
                _log.warning(
                    "entry point %s = %s of %s is left out: %s: %s",
                    point.name, point.value, GROUP, type(error).__name__, words,
                )  # fmt: skip
