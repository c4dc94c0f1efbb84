"""The run folders of a descent in stages: which there are, which of them has the result, and which stage one is of."""

from __future__ import annotations

from pathlib import Path

from unrender.app.stages import stages_file
from unrender.app.stages.stages_file import Stages
from unrender.runs.folder import schema


def listed(directory: Path) -> list[Path]:
    """The run folders of a folder of stages, also of those that have not begun; of any other, itself. Raises `InputError`."""
    if not (directory / stages_file.FILE).is_file():
        return [directory]
    stages = stages_file.read(directory / stages_file.FILE)
    if not stages_file.is_of_run(directory / stages_file.FILE):
        return [directory]
    return [stages_file.folder_of(stages, index, directory) for index in range(len(stages.stages))]


def last_result(directory: Path) -> Path:
    """Of a folder of stages, the run folder of the last that has begun; any other, as it is. Raises `InputError`."""
    if (directory / schema.RECORD).is_file():
        return directory
    return next((run for run in reversed(listed(directory)) if (run / schema.RECORD).is_file()), directory)


def stage_of(run: Path) -> tuple[Stages, int] | None:
    """The stages that a run folder is one of, and its place among them; None where it is of none. Raises `InputError`."""
    out, name = run.resolve().parent, run.resolve().name
    if not stages_file.is_of_run(out / stages_file.FILE):
        return None
    stages = stages_file.read(out / stages_file.FILE)
    names = [stages_file.folder_of(stages, index, out).name for index in range(len(stages.stages))]
    return (stages, names.index(name)) if name in names else None
