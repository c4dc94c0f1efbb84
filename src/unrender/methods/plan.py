"""Plans: everything that a method decides for a problem; and plans in files, which run like methods."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomli_w

from unrender.core import lazy
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean, in_words

if TYPE_CHECKING:
    from unrender.core import tables
    from unrender.estimators.base import Estimator
    from unrender.io import bounded_files, toml_lines
    from unrender.optimizers import transforms
    from unrender.optimizers.base import Optimizer
    from unrender.preconditioners.mesh import MeshTopology
    from unrender.scene import coarse_to_fine, parameter
    from unrender.scene.parameter import ParameterSettings
    from unrender.scene.problem import Problem
else:  # methods are listed without Dr.Jit
    tables, transforms, bounded_files = lazy.modules("core.tables", "optimizers.transforms", "io.bounded_files")
    toml_lines, coarse_to_fine, parameter = lazy.modules("io.toml_lines", "scene.coarse_to_fine", "scene.parameter")

_COMPONENTS = ("estimator", "optimizer")


@dataclass(frozen=True)
class Plan:
    """Everything that a method decides for a problem. `unrender.optimize` executes it unchanged.

    Attributes:
        problem: Problem as passed.
        estimator: Estimator of gradients.
        optimizer: Optimizer.
        settings: {key: settings of a parameter whose own are None}.
        reasons: Choices and their reasons, one line each.
        other_starts: Keys of unknowns of which other values are compared once during a run, see `runs.refinement`.
        cheaper: Function from a share of the time of a step to another plan with about that, and the options that differ; None without one.
    """

    problem: Problem
    estimator: Estimator
    optimizer: Optimizer
    settings: Mapping[str, ParameterSettings] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()
    other_starts: tuple[str, ...] = ()
    cheaper: Callable[[float], tuple[Plan, Mapping[str, int]] | None] | None = field(
        default=None, compare=False, repr=False
    )

    @property
    def lines(self) -> tuple[str, ...]:
        """The reasons, and the problem's priors, which are part of the loss, one line each."""
        priors = {key: u.prior for key, u in self.problem.unknowns.items() if u.prior is not None}
        return (*self.reasons, *(f"prior of {key}: {prior.describe()}" for key, prior in priors.items()))

    def configured(self) -> Problem:
        """Return the problem with the settings of this plan. Raises `InputError` for an unsuitable setting."""
        return self.problem.configured(self.settings)

    def table(self) -> dict[str, Any]:
        """Return the plan as a TOML table: estimator, optimizer, settings by key, and keys of other starts.

        A component that cannot be described becomes a text with the reason.
        """
        parts: dict[str, Any] = {name: _table(getattr(self, name)) for name in _COMPONENTS}
        settings = {key: table for key, own in self.settings.items() if (table := _settings_table(own))}
        others = {"other_starts": list(self.other_starts)} if self.other_starts else {}
        return parts | others | ({"settings": settings} if settings else {})

    @classmethod
    def from_table(
        cls,
        problem: Problem,
        table: Mapping[str, Any],
        where: str,
        estimator: Estimator | None = None,
        optimizer: Optimizer | None = None,
    ) -> Plan:
        """Return the plan of a table.

        Args:
            problem: Problem to recover.
            table: Table as returned by `Plan.table`.
            where: Beginning of messages.
            estimator, optimizer: Components that replace the table's.

        Raises:
            InputError: A component is not described, is of another kind, or does not suit the problem.
        """
        parts = {"estimator": estimator, "optimizer": optimizer}
        made = {name: parts[name] or _component(table.get(name), name, where) for name in _COMPONENTS}
        for name, method in zip(_COMPONENTS, ("estimate", "update"), strict=True):
            if not callable(getattr(made[name], method, None)):
                raise InputError(f"{where}: {name}: {type(made[name]).__name__} is not an {name}")
        entries = table.get("settings", {})
        if not isinstance(entries, Mapping):
            raise InputError(f"{where}: settings: expected a table of settings by key, got {in_words(entries)}")
        if other := next((key for key in entries if key not in problem.unknowns), None):
            raise InputError(f"{where}: settings: {other} is not an unknown{did_you_mean(other, problem.unknowns)}")
        settings = {key: _settings(own, f"{where}: settings: {key}") for key, own in entries.items()}
        others = table.get("other_starts", [])
        if not isinstance(others, list) or not all(isinstance(key, str) and key in problem.unknowns for key in others):
            raise InputError(f"{where}: other_starts: expected a list of unknowns, got {in_words(others)}")
        return cls(problem, made["estimator"], made["optimizer"], settings, other_starts=tuple(others))


def bind(part: Any, topology: Callable[[str], MeshTopology | None], repeated: Mapping[str, int]) -> Any:
    """Return an optimizer whose preconditioners know the neighbours of a parameter's elements: its mesh, and repeated border columns.

    Every `FittedSobolev` is bound, wherever it is among the fields of the optimizer and its parts.
    """
    if isinstance(part, transforms.FittedSobolev):
        return part.bound(topology, repeated)
    if isinstance(part, tuple):
        parts = tuple(bind(each, topology, repeated) for each in part)
        return part if all(map(operator.is_, part, parts)) else parts
    if not is_dataclass(part) or isinstance(part, type):
        return part
    pairs = {each.name: getattr(part, each.name) for each in fields(part)}
    bound = {name: new for name, old in pairs.items() if (new := bind(old, topology, repeated)) is not old}
    if not bound:
        return part
    result = replace(part)
    for name, value in bound.items():  # also of fields that are no arguments
        object.__setattr__(result, name, value)
    return result


def _table(component: Any) -> dict[str, Any] | str:
    try:
        return tables.table(component)
    except tables.NotStorable as error:
        return f"it cannot be stored in a file ({error})"


def _component(table: Any, name: str, where: str) -> Any:
    if isinstance(table, str):
        raise InputError(f"{where}: {name}: {table}; pass it: unrender.resume(..., {name}=...)")
    return tables.component(table, where=f"{where}: {name}")


def _settings_table(own: ParameterSettings) -> dict[str, Any]:
    settings: dict[str, Any] = {}
    if own.parameterisation is not None:
        named = isinstance(own.parameterisation, str)
        settings["parameterisation"] = own.parameterisation if named else _table(own.parameterisation)
    if own.preconditioner is not None:
        settings["preconditioner"] = _table(own.preconditioner)
    if own.coarse_to_fine is not None:
        settings["coarse_to_fine"] = tables.fields(own.coarse_to_fine)
    if own.start_factor is not None:
        settings["start_factor"] = own.start_factor
    if own.start is not None:
        settings["start"] = list(own.start)
    return settings


def _settings(table: Any, where: str) -> ParameterSettings:
    """Return the settings of a table. Raises `InputError`."""
    if not isinstance(table, Mapping) or set(table) - set(vars(parameter.ParameterSettings())):
        raise InputError(f"{where}: expected {', '.join(vars(parameter.ParameterSettings()))}, got {in_words(table)}")
    made: dict[str, Any] = dict(table)
    if "preconditioner" in made:
        made["preconditioner"] = tables.component(made["preconditioner"], "preconditioner", where=where)
    try:
        if "coarse_to_fine" in made:
            made["coarse_to_fine"] = tables.options(
                coarse_to_fine.CoarseToFine, made["coarse_to_fine"], "{ steps = [100] }"
            )
        return parameter.ParameterSettings(**made)
    except InputError as error:
        raise InputError(f"{where}: {str(error).removeprefix('settings: ')}") from error


_LONGEST = 1 << 20


@dataclass(frozen=True)
class PlanFile:
    """Plan in a TOML file, as printed by `unrender methods --plan`, with the members of `Method` that a run needs."""

    path: Path

    @property
    def name(self) -> str:
        """Name of the run's method: the file's without its suffix."""
        return self.path.stem

    def options_of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return no options. Raises `InputError` for settings, because a plan is complete."""
        for name in settings:
            raise InputError(f"--set {name}: {self.path} is a plan, which contains all settings; edit the file")
        return {}

    def start(self, settings: Mapping[str, Any]) -> None:
        """Raise `InputError` for settings, or for a file that cannot be read."""
        self.options_of(settings)
        self._table()

    def plan(self, problem: Problem, settings: Mapping[str, Any] | None = None) -> Plan:
        """Return the plan for a problem. Raises `InputError` that names the file and the field."""
        self.options_of(settings or {})
        return Plan.from_table(problem, self._table(), str(self.path))

    def _table(self) -> dict[str, Any]:
        folder = self.path.resolve().parent
        return toml_lines.parse(bounded_files.read_text(self.path, _LONGEST, folder), str(self.path))


def plan_text(plan: Plan) -> str:
    """Return a plan as a TOML file with its reasons as comments. Raises `InputError` for a component that cannot be described."""
    table = plan.table()
    for name in ("estimator", "optimizer"):
        if isinstance(table[name], str):
            raise InputError(f"{name}: {table[name]}")
    reasons = "".join(f"# {line}\n" for line in plan.lines)
    return f"{reasons}\n{tomli_w.dumps(table)}" if reasons else tomli_w.dumps(table)
