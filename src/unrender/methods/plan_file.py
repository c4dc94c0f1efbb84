"""Plans in files, which run like methods."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from unrender.core.errors import InputError
from unrender.io import bounded_files, toml_lines
from unrender.methods.plan import Plan
from unrender.scene.problem import Problem

SUFFIX = ".toml"
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


def text(plan: Plan) -> str:
    """Return a plan as a TOML file with its reasons as comments. Raises `InputError` for a component that cannot be described."""
    table = plan.table()
    for name in ("estimator", "optimizer"):
        if isinstance(table[name], str):
            raise InputError(f"{name}: {table[name]}")
    reasons = "".join(f"# {line}\n" for line in plan.lines)
    return f"{reasons}\n{tomli_w.dumps(table)}" if reasons else tomli_w.dumps(table)
