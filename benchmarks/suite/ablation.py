"""Plans of `auto` without one of its parts, and the geometric mean of the speed-up without each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import unrender as ur
from benchmarks import markdown
from benchmarks.internals import CachingSession, Plan, RendererWrapper, method, newton, rules_of_paths
from benchmarks.runner.records import Record


def _with_adam(plan: Plan) -> Plan:
    """Return the plan with Adam at the same first rates, which stay constant."""
    if not isinstance(plan.optimizer, ur.optimizers.ScheduleFree):
        return plan
    return replace(plan, optimizer=ur.optimizers.Adam(plan.optimizer.learning_rate))


def _with_separate_adjoints(plan: Plan) -> Plan:
    """Return the plan with adjoints on paths of their own, as many as the image has."""
    if not isinstance(plan.estimator, ur.PathGradient):
        return plan
    return replace(plan, estimator=replace(plan.estimator, adjoint_spp=plan.estimator.spp))


class _Uncached(RendererWrapper):
    """A renderer whose sessions trace the paths of each image and adjoint."""

    def prepare(self, *arguments: Any, **named: Any) -> Any:
        session = self.inner.prepare(*arguments, **named)
        return session._inner if isinstance(session, CachingSession) else session


def _without_cache(plan: Plan) -> Plan:
    return replace(plan, problem=plan.problem.with_parts(renderer=_Uncached(plan.problem.renderer)))


def _without_newton(plan: Plan) -> Plan:
    """Return the plan without the rules that take Gauss-Newton steps for all unknowns, and without such steps after path gradients."""
    rules = tuple(rule for rule in rules_of_paths.RULES if rule.__module__ != newton.__name__)
    with patch.object(rules_of_paths, "RULES", rules):
        made = method("auto").plan(plan.problem)
    if not isinstance(made.estimator, ur.estimators.PathThenNewton):
        return made
    return replace(made, estimator=made.estimator.path, optimizer=made.optimizer.first)  # pyright: ignore[reportAttributeAccessIssue]


PARTS: dict[str, dict[str, str] | Callable[[Plan], Plan]] = {
    "kept-paths": _without_cache,
    "control-variate": {"image": "plain"},
    "sobolev": {"smooth": "false"},
    "schedule-free": _with_adam,
    "leave-one-out": _with_separate_adjoints,
    "damping": {"tolerance": "0"},
    "model-steps": _without_newton,
}
"""{part: options of `auto` that leave it out, or the change of its plan}."""


def plan(problem: ur.Problem, option: str = "") -> Plan:
    """Return the plan of `auto` with an option such as "spp=2", or without one of `PARTS`."""
    own, part = method("auto"), PARTS.get(option, {})
    if callable(part):
        return part(own.plan(problem))
    return own.configure(part or (dict([option.split("=")]) if option else {})).plan(problem)


def changes(problem: ur.Problem, part: str) -> bool:
    """Return whether the plan for a problem has this part."""
    own, other = plan(problem), plan(problem, part)
    return replace(own, reasons=()) != replace(other, reasons=())


def table(entries: list[Record], mean: Callable[[list[float | None]], float]) -> str:
    """Return the geometric mean of the speed-up without each part; `mean` takes a speed per entry. "" if none was left out."""
    if not all("without" in entry for entry in entries):
        return ""
    own = mean([entry["speed"] for entry in entries])
    rows = [["", f"{own:.2f}", "1", ""]]
    for part in entries[0]["without"]:
        left = [entry["without"][part] for entry in entries]
        speed = mean([one["speed"] for one in left])
        rows.append([part, f"{speed:.2f}", f"{speed / own:.2f}", str(sum(one["changed"] for one in left))])
    return markdown.table(
        "without | geometric mean of the speed-up | over that of all parts | problems with the part", rows
    )
