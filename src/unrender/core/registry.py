"""The registry of components: what the command line, TOML files, `resume` and the contract suites know by name.

    @unrender.register
    @dataclass(frozen=True)
    class Charbonnier:
        \"\"\"A loss: it has `value` and `derivative`.\"\"\"

A package announces its components by an entry point of the group `unrender.components` whose module registers them on import:

    [project.entry-points."unrender.components"]
    charbonnier = "my_package.losses"

The modules of `unrender` itself are imported when a kind of theirs is first asked for, entry points at the first look-up of any name. No
module is ever imported because a file names it.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.metadata
import logging
import math
import pkgutil
import re
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar, overload

from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean

GROUP = "unrender.components"
"""The entry-point group."""

_log = logging.getLogger("unrender")
_C = TypeVar("_C", bound=type)


@dataclass(frozen=True)
class Kind:
    """A kind of component.

    Attributes:
        name: in words, as `register(kind=)` takes it.
        package: whose modules hold those of `unrender`; "" where there are none.
        protocol: what a class may inherit from to declare its kind, as "module.Name".
        members: sets of methods by which other classes are known; empty where the protocol must be inherited.
        in_tables: whether a table {type = "Name", ...} makes one; its fields are those of a frozen dataclass.
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
        _kind("loss", "unrender.losses", "unrender.losses.base.Loss", "value derivative"),
        _kind("schedule", "unrender.schedules", "unrender.schedules.functions.Schedule", "__call__"),
        _kind("parameterisation", "unrender.parameterisations", "unrender.parameterisations.base.Parameterisation", "transform"),
        _kind("preconditioner", "unrender.preconditioners", "unrender.preconditioners.base.Preconditioner", "check apply"),
        _kind("pixel sampler", "unrender.pixels", "unrender.pixels.base.PixelSampler", "init draw observe"),
        _kind("image estimator", "unrender.images", "unrender.images.base.ImageEstimator", "init estimate advance"),
        _kind("estimator", "unrender.estimators", "unrender.estimators.base.Estimator", "init estimate"),
        _kind("optimizer", "unrender.optimizers", "unrender.optimizers.base.Optimizer", "init update"),
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
    """A registered class.

    Attributes:
        name: by which it is found.
        kind: of `KINDS`.
        made_by: the class.
        position: its place in lists; those without one come last, by name.
    """

    name: str
    kind: str
    made_by: type
    position: float = math.inf


_components: dict[tuple[str, str], Component] = {}
"""By namespace and name: all kinds that stand in tables share a namespace, each other kind has its own."""

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
    """Decorator: make a class known by name. It stands above `@dataclass(frozen=True)`.

    Args:
        name: by which it is found; None takes the class's, for methods and gallery problems in lower case with hyphens ("TwoPlanets" as
            two-planets).
        kind: of `registry.KINDS`; None takes that of the protocol which the class inherits from, or whose methods it has.
        states: the module of its states, where that is not its own. Checkpoints make frozen dataclasses of registered components' modules
            again, and of no others.
        position: its place in lists, ascending; None comes last, by name.

    Raises:
        InputError: the kind cannot be told or does not exist; no frozen dataclass, where tables make it from its fields; another component
            has this name.
    """
    if component is None:
        return lambda made_by: _add(made_by, name, kind, states, position)
    return _add(component, name, kind, states, position)


def components(kind: str) -> dict[str, type]:
    """{name: class} of every component of a kind, in their order. Raises `InputError` for an unknown kind."""
    _check_kind(kind)
    _load(kind)
    found = [each for each in _components.values() if each.kind == kind]
    return {each.name: each.made_by for each in sorted(found, key=lambda each: (each.position, each.name))}


def table_components() -> dict[str, type]:
    """{name: class} of every component that a table {type = "Name", ...} can make, of all kinds."""
    return {
        name: made_by for kind in KINDS.values() if kind.in_tables for name, made_by in components(kind.name).items()
    }


def find(kind: str, name: str) -> type:
    """The component of a kind by its name. Raises `InputError` with the nearest known name."""
    known = components(kind)
    if name not in known:
        hint = did_you_mean(name, known) or f"; there are {', '.join(known)}"
        raise InputError(f"unknown {kind} {name}{hint}")
    return known[name]


def component_of(made_by: type) -> Component | None:
    """What a class is registered as, or None."""
    return next((each for each in _components.values() if each.made_by is made_by), None)


def kind_of_protocol(protocol: Any) -> str | None:
    """The kind that a protocol stands for, such as "loss" for `losses.Loss`, or None."""
    path = f"{getattr(protocol, '__module__', '')}.{getattr(protocol, '__qualname__', '')}"
    return next((kind.name for kind in KINDS.values() if kind.protocol == path), None)


def state_modules() -> frozenset[str]:
    """The modules whose frozen dataclasses a checkpoint may make again: those of the registered components."""
    _load_entry_points()
    return frozenset(_state_modules)


def _add(made_by: Any, name: str | None, kind: str | None, states: str | None, position: float | None) -> Any:
    if not isinstance(made_by, type):
        raise InputError(f"register: expected a class, got {made_by!r:.80}")
    where = f"{made_by.__module__}.{made_by.__qualname__}"
    chosen = _detect(made_by, where) if kind is None else _check_kind(kind)
    parameters: Any = getattr(made_by, "__dataclass_params__", None)
    if chosen.in_tables and not (dataclasses.is_dataclass(made_by) and parameters.frozen):
        raise InputError(
            f"register: {where}: a component is a frozen dataclass; put @register above @dataclass(frozen=True)"
        )
    if not chosen.members and chosen.protocol not in _bases(made_by):
        raise InputError(f"register: {where}: a {chosen.name} inherits from {chosen.protocol}")
    called = name or (made_by.__name__ if chosen.in_tables else _hyphenated(made_by.__name__))
    space = "table" if chosen.in_tables else chosen.name
    with _lock:
        known = _components.get((space, called))
        # The same class may come again: a module that is reloaded, a notebook's cell that is run twice.
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
    """Have the constructor refuse unknown keyword arguments by an `InputError` that names the nearest known one."""
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
    if kind not in KINDS:
        hint = did_you_mean(str(kind), KINDS) or f"; there are {', '.join(KINDS)}"
        raise InputError(f"register: no kind {kind!r}{hint}")
    return KINDS[kind]


def _detect(made_by: type, where: str) -> Kind:
    """The kind of the protocol that a class inherits from, else of the one most of whose members it has."""
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


def _hyphenated(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", name).lower()


def _load(kind: str) -> None:
    """Import the modules of `unrender` that hold components of this kind, then entry points. Once each."""
    package = KINDS[kind].package
    with _lock:
        if package and package not in _loaded:
            _loaded.add(package)
            try:
                home = importlib.import_module(package)
                for module in pkgutil.iter_modules(home.__path__, f"{package}."):
                    importlib.import_module(module.name)
            except BaseException:
                _loaded.discard(package)
                raise
        _load_entry_points()


def _load_entry_points() -> None:
    """Import what other packages announce. One that fails is one line of the log, and left out."""
    with _lock:
        if GROUP in _loaded:
            return
        _loaded.add(GROUP)
        for point in importlib.metadata.entry_points(group=GROUP):
            try:
                point.load()
            except KeyboardInterrupt:
                raise
            except BaseException as error:  # whatever a module of others raises
                # Those of a module whose import failed; other modules that it imported stay, and so do theirs.
                for key in [key for key, each in _components.items() if each.made_by.__module__ not in sys.modules]:
                    del _components[key]
                words = " ".join(str(error).split())[:200]
                _log.warning(
                    "entry point %s = %s of %s is left out: %s: %s",
                    point.name, point.value, GROUP, type(error).__name__, words,
                )  # fmt: skip
