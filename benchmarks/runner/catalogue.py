"""The benchmarks, found by their folders."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
"""The repository."""
PACKAGE = ROOT / "benchmarks"
ORDER = (
    *("suite", "own_loop", "speed", "peers", "rcv.fig9_reconstruction", "rcv", "meta", "higher_order", "adaptive"),
    *("volumes", "shapes"),
)
"""The order of the list and of the results page, by prefixes of names; the alphabet decides within a prefix."""


@dataclass(frozen=True)
class Benchmark:
    """One folder.

    Attributes:
        name: of the folder, with dots: "rcv.fig4_order".
        folder: with run.py, notes.md, and, once measured, results.json, and maps.npz where it keeps images.
    """

    name: str
    folder: Path

    @property
    def module(self) -> ModuleType:
        """Its module run.py: `run` measures, `table` and `plot` show a record."""
        return importlib.import_module(f"benchmarks.{self.name}.run")

    def table(self, record: dict[str, Any]) -> str:
        """Return the tables of a record as Markdown."""
        return self.module.table(record)

    @property
    def plot(self) -> Callable[[dict[str, Any]], Any] | None:
        """The function that draws a record; None where the table says it all."""
        return getattr(self.module, "plot", None)

    @property
    def docstring(self) -> str:
        """What run.py says of itself, read without importing it."""
        return ast.get_docstring(ast.parse((self.folder / "run.py").read_text())) or ""

    @property
    def summary(self) -> str:
        """One line."""
        return self.docstring.partition("\n")[0]


def benchmarks() -> dict[str, Benchmark]:
    """All, by name, in order."""
    folders = (path.parent for path in PACKAGE.rglob("run.py") if path.parent != PACKAGE)
    found = [Benchmark(".".join(folder.relative_to(PACKAGE).parts), folder) for folder in folders]

    def rank(benchmark: Benchmark) -> tuple[int, str]:
        prefixes = (n for n, prefix in enumerate(ORDER) if f"{benchmark.name}.".startswith(f"{prefix}."))
        return next(prefixes, len(ORDER)), benchmark.name

    return {benchmark.name: benchmark for benchmark in sorted(found, key=rank)}
