"""Methods and their options."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pydantic
from pydantic import BaseModel, ConfigDict

from unrender.core import registry, tables
from unrender.core.errors import InputError, UnknownOptionError
from unrender.core.text import did_you_mean, grouped
from unrender.estimators.base import Estimator
from unrender.methods import effects
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
            expected = f"expected {self.expected(name)}, got {detail['input']!r}"
            raise InputError(f"method {self.name}: option {name}: {expected}") from error
        for name, value in options:
            if isinstance(value, int) and value >= _TOO_LARGE:
                expected = f"expected {self.expected(name)} and below 2**31, got {value}"
                raise InputError(f"method {self.name}: option {name}: {expected}")
        return options

    def options_of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return all options by name, with `settings` in place of defaults. Raises `InputError`."""
        return self.configure(settings).model_dump()

    def expected(self, name: str) -> str:
        """Return a description of an option's values: "a whole number above 0"."""
        schema = self.options.model_json_schema()["properties"][name]
        choices = [_in_words(choice) for choice in schema.get("anyOf", [schema])]
        return " or ".join(choices)

    def start(self, settings: Mapping[str, Any] | None = None) -> tuple[Estimator, Optimizer]:
        """Return estimator and optimizer with `settings` in place of defaults. Raises `InputError`."""
        options = self.configure(settings or {})
        with self._named():
            parts = options.build()
            if self.options.plan is Options.plan:  # otherwise the problem decides which options have an effect
                for name in settings or {}:
                    effects.check(options, name, lambda one: one.build(), parts)
            return parts

    def plan(self, problem: Problem, settings: Mapping[str, Any] | None = None) -> Plan:
        """Return the plan for a problem, with `settings` in place of defaults. Raises `InputError`, also for one without effect."""
        options = self.configure(settings or {})
        with self._named(), effects.measuring_once():
            plan = options.plan(problem)
            for name in settings or {}:
                effects.check(options, name, lambda one: _decisions(one.plan(problem)), _decisions(plan))
            return plan

    def with_effect(self, problem: Problem, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings that change the plan for a problem. Raises `InputError`."""
        options = self.configure(settings)
        with self._named(), effects.measuring_once():
            decide: effects.Decide = lambda one: _decisions(one.plan(problem))  # noqa: E731
            decided = decide(options)
            return {name: x for name, x in settings.items() if effects.has_effect(options, name, decide, decided)}

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Prefix errors with the method's name."""
        try:
            yield
        except InputError as error:
            raise InputError(f"method {self.name}: {error}") from error


def _decisions(plan: Plan) -> tuple[Any, ...]:
    """Return all of a plan but its reasons."""
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
    return None if text is None else tables.parse(text, "schedule")


def _in_words(schema: Mapping[str, Any]) -> str:
    """Describe a part of a JSON schema in words."""
    if "enum" in schema:
        return " or ".join(schema["enum"])
    words = {"integer": "a whole number", "number": "a number", "null": "none", "boolean": "true or false"}.get(
        schema.get("type", ""), "text"
    )
    names = {"exclusiveMinimum": "above", "minimum": "of at least", "exclusiveMaximum": "below", "maximum": "up to"}
    limits = [f"{word} {schema[name]:g}" for name, word in names.items() if name in schema]
    return f"{words} {' and '.join(limits)}".rstrip()
