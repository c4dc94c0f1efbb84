"""The problem file with the photographs that were held out, beside a run's own."""

from __future__ import annotations

from pathlib import Path

from unrender.app.stages import run_folders
from unrender.core.errors import InputError
from unrender.scene.problem import Problem

__all__ = ["HELD_OUT", "find"]

HELD_OUT = "held-out.toml"


def find(run: Path, problem: Problem) -> Path:
    """held-out.toml beside the problem file of a run, or beside that of the stages that it is one of. Raises `InputError`."""
    staged = run_folders.stage_of(run)
    origin = problem.origin.get("file", problem.origin.get("scene")) if staged is None else staged[0].problem
    beside = None if origin is None else Path(origin).parent / HELD_OUT
    if beside is None or not beside.is_file():
        where = "" if beside is None else f", and there is none at {beside}"
        raise InputError(f"{run}: give --held-out FILE, a problem file with other views{where}")
    return beside
