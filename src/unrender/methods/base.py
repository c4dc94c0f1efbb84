"""Methods and their options, options without effect because of others or of the problem, and measurements that plans share."""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import pydantic
from pydantic import BaseModel, ConfigDict

from unrender.core import registry
from unrender.core.errors import InputError, UnknownOptionError, prefixed
from unrender.core.text import did_you_mean, grouped, in_words

if TYPE_CHECKING:
    from unrender.estimators.base import Estimator
    from unrender.methods.plan import Plan
    from unrender.optimizers.base import Optimizer
    from unrender.scene.problem import Problem
    from unrender.schedules import Schedule

SCHEDULE_HELP = "schedule of the learning rate: cosine(300), exponential(100), steps(100, 0.5), warmup(20)"
_TOO_LARGE = 1 << 31
"""Lower bound of integers for which no array of so many samples or steps can be allocated."""


class Options(BaseModel):
    """Options of a method: each field has a description, a default and a range; `build` returns estimator and optimizer.

    The first line of a subclass's docstring is its summary. `@unrender.register(name=...)` registers it as a method.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def build(self) -> tuple[Estimator, Optimizer]:
        """Return estimator and optimizer with these options. Raises `InputError` for incompatible options."""
        raise NotImplementedError(f"{type(self).__name__} has no build")

    def plan(self, problem: Problem) -> Plan:
        """Return the plan for a problem: the result of `build`, unless the method depends on the problem."""
        from unrender.methods.plan import Plan  # imports Dr.Jit

        return Plan(problem, *self.build(), reasons=parameterised(problem))


@dataclass(frozen=True)
class Method:
    """A named method to recover a problem's parameters.

    Attributes:
        name: name on the command line.
        options: class of its options.
    """

    name: str
    options: type[Options]

    @property
    def summary(self) -> str:
        """Description of the estimator and the optimizer, in one line."""
        return (self.options.__doc__ or "").strip().split("\n")[0]

    def configure(self, settings: Mapping[str, Any]) -> Options:
        """Return the options with `settings` in place of defaults; text is converted ("4" to 4, "none" to None).

        Raises:
            InputError: an unknown option (with the nearest known one), or a value of the wrong type or out of range.
        """
        fields = self.options.model_fields
        for name in settings:
            if name not in fields:
                near = did_you_mean(name, fields)
                hint = near or f"; it has {', '.join(fields)}"
                others = ", ".join(other for other in methods() if name in method(other).options.model_fields)
                if others:
                    hint += f"; --method {others} {'have' if ',' in others else 'has'} it"
                kind = InputError if others else UnknownOptionError
                raise kind(f"method {self.name} has no option {name}{hint}")
        none = {name: None for name, value in settings.items() if isinstance(value, str) and value.lower() == "none"}
        try:
            options = self.options.model_validate({**settings, **none})
        except pydantic.ValidationError as error:
            detail = error.errors()[0]
            name = str(detail["loc"][0])
            expected = f"expected {self.expected(name)}, got {in_words(detail['input'])}"
            raise InputError(f"method {self.name}: option {name}: {expected}") from error
        for name, value in options:
            if isinstance(value, int) and value >= _TOO_LARGE:
                expected = f"expected {self.expected(name)} and below 2**31, got {in_words(value)}"
                raise InputError(f"method {self.name}: option {name}: {expected}")
        return options

    def options_of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return all options by name, with `settings` in place of defaults. Raises `InputError`."""
        return self.configure(settings).model_dump()

    def expected(self, name: str) -> str:
        """Return a description of an option's values: "a whole number above 0"."""
        schema = self.options.model_json_schema()["properties"][name]
        choices = [_described(choice) for choice in schema.get("anyOf", [schema])]
        return " or ".join(choices)

    def start(self, settings: Mapping[str, Any] | None = None) -> tuple[Estimator, Optimizer]:
        """Return estimator and optimizer with `settings` in place of defaults. Raises `InputError`."""
        options = self.configure(settings or {})
        with prefixed(f"method {self.name}"):
            parts = options.build()
            if self.options.plan is Options.plan:  # otherwise the problem decides which options have an effect
                for name in settings or {}:
                    check_effect(options, name, lambda one: one.build(), parts)
            return parts

    def plan(self, problem: Problem, settings: Mapping[str, Any] | None = None) -> Plan:
        """Return the plan for a problem, with `settings` in place of defaults. Raises `InputError`, also for one without effect."""
        options = self.configure(settings or {})
        with prefixed(f"method {self.name}"), measuring_once():
            plan = options.plan(problem)
            for name in settings or {}:
                check_effect(options, name, lambda one: _decisions(one.plan(problem)), _decisions(plan))
            return plan

    def with_effect(self, problem: Problem, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings that change the plan for a problem. Raises `InputError`."""
        options = self.configure(settings)
        with prefixed(f"method {self.name}"), measuring_once():
            decide: Decide = lambda one: _decisions(one.plan(problem))  # noqa: E731
            decided = decide(options)
            return {name: x for name, x in settings.items() if has_effect(options, name, decide, decided)}


def _decisions(plan: Plan) -> tuple[Any, ...]:
    return plan.estimator, plan.optimizer, dict(plan.settings), plan.other_starts


def parameterised(problem: Problem) -> tuple[str, ...]:
    """Return a line with the parameterisations of parameters, such as "parameterised as log (lamp.radiance)"; empty if there are none."""
    parameterisations = {
        key: u.parameterisation for key, u in problem.unknowns.items() if u.parameterisation is not None
    }
    named = {key: type(own).__name__.lower() for key, own in parameterisations.items()}
    return (f"parameterised as {grouped(named)}",) if named else ()


def methods() -> dict[str, Method]:
    """Return every registered method by name."""
    return {name: Method(name, options) for name, options in registry.components("method").items()}


def method(name: str) -> Method:
    """Return the method of this name. Raises `InputError` with the nearest known name."""
    return Method(name, registry.find("method", name))


def parse_schedule(text: str | None) -> Schedule | None:
    """Return the schedule that `text` describes: "cosine(300)", "warmup(20) then exponential(100)"; None for None.

    Raises:
        InputError: an unknown name, or invalid arguments.
    """
    from unrender.core import tables  # imports NumPy

    return None if text is None else tables.parse(text, "schedule")


def _described(schema: Mapping[str, Any]) -> str:
    """Describe a part of a JSON schema in words."""
    if "enum" in schema:
        return " or ".join(schema["enum"])
    words = {"integer": "a whole number", "number": "a number", "null": "none", "boolean": "true or false"}.get(
        schema.get("type", ""), "text"
    )
    names = {"exclusiveMinimum": "above", "minimum": "of at least", "exclusiveMaximum": "below", "maximum": "up to"}
    limits = [f"{word} {schema[name]:g}" for name, word in names.items() if name in schema]
    return f"{words} {' and '.join(limits)}".rstrip()


Decide = Callable[[Any], Any]
"""Function that returns what options decide, an object that `repr` shows in full. Raises `InputError` for incompatible options."""


Measured = TypeVar("Measured")
_measured: ContextVar[dict[Hashable, tuple[Any, Any]] | None] = ContextVar("measured", default=None)

_NUMBER = re.compile(r"\d+(\.\d*)?(e[-+]?\d+)?")


@contextmanager
def measuring_once(known: dict[Any, Any] | None = None) -> Iterator[None]:
    """Render for equal plans once: `measure` keeps its results within this block, beside `known` ones of an earlier block."""
    before = _measured.set({} if known is None else known)
    try:
        yield
    finally:
        _measured.reset(before)


def measured() -> dict[Any, Any] | None:
    """Return the results of `measure` in this block, for `measuring_once`; None outside of one."""
    return _measured.get()


def measure(problem: Any, key: tuple[Hashable, ...], function: Callable[[], Measured]) -> Measured:
    """Return a result that renders of a problem and `key` decide alone, within `measuring_once` the one of an equal call."""
    known = _measured.get()
    if known is None:
        return function()
    name = (id(problem), *key)
    if name not in known:
        known[name] = problem, function()  # with the problem, so that its id stays its own
    return known[name][1]


def check_effect(options: BaseModel, name: str, decide: Decide, decided: Any) -> None:
    """Raise `InputError` for an option without effect, and say which other options it needs. `decided` is what the options decide."""
    if has_effect(options, name, decide, decided):
        return
    needed, beside = [], []
    for other in type(options).model_fields:
        for value in choices(options, other) if other != name else ():
            changed = _changed(options, other, value)
            if changed is None or isinstance(then := _outcome(changed, decide), InputError):
                continue
            if has_effect(changed, name, decide, then):
                needed.append(f"{other}={_text(value)}")
                beside.append(f"{other}={_text(getattr(options, other))}")
    if needed:
        present = " and ".join(dict.fromkeys(beside))
        raise InputError(f"option {name} has no effect with {present}; it needs {' or '.join(needed)}")
    raise InputError(f"option {name} has no effect with these options on this problem; leave it out")


def has_effect(options: BaseModel, name: str, decide: Decide, decided: Any) -> bool:
    """Return whether an option has its default, or another value of it would decide something else.

    Another value than the default counts, because the option may ask for what the method would choose anyway. Options of registered methods
    always count, because `repr` of their parts may not show them.
    """
    ours = type(options).__module__.startswith("unrender.")
    if not ours or getattr(options, name) == type(options).model_fields[name].default:
        return True
    return any(repr(_outcome(other, decide)) != repr(decided) for other in _others(options, name))


def _others(options: BaseModel, name: str) -> Iterator[BaseModel]:
    """Yield the options with other values of one of them: its default, its other choices, or other numbers."""
    own = getattr(options, name)
    numbers: list[Any] = []
    if isinstance(own, str):
        numbers = [_NUMBER.sub(lambda found: f"{2.0 * float(found[0]):g}", own)]
    elif isinstance(own, (int, float)) and not isinstance(own, bool):
        numbers = [2 * own, own / 2, own + 1]
    for value in [type(options).model_fields[name].default, *choices(options, name), *numbers]:
        if value != own and (changed := _changed(options, name, value)) is not None:
            yield changed


def choices(options: BaseModel, name: str) -> list[Any]:
    """Return the other values of an option with a few values; [] for numbers and texts."""
    schema, own = type(options).model_json_schema()["properties"][name], getattr(options, name)
    kinds = schema.get("anyOf", [schema])
    values = [x for kind in kinds for x in kind.get("enum") or [True, False] * (kind.get("type") == "boolean")]
    return [value for value in values if value != own]


def _changed(options: BaseModel, name: str, value: Any) -> BaseModel | None:
    try:
        return type(options).model_validate({**options.model_dump(), name: value})
    except pydantic.ValidationError:
        return None


def _outcome(options: BaseModel, decide: Decide) -> Any:
    try:
        return decide(options)
    except InputError as error:
        return error


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) or value is None else str(value)
