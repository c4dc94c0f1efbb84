"""The run folders of a run in stages: their list, the folder of the result, and the stage of a folder."""

from __future__ import annotations

from pathlib import Path

from unrender.app.stages import stages_file
from unrender.app.stages.stages_file import Stages
from unrender.runs.folder import schema


def listed(directory: Path) -> list[Path]:
    """Return the run folders of a folder of stages, including stages that have not started; any other folder is returned alone.

    Raises:
        InputError: the file of stages is malformed.
    """
    if not (directory / stages_file.FILE).is_file():
        return [directory]
    stages = stages_file.read(directory / stages_file.FILE)
    if not stages_file.is_of_run(directory / stages_file.FILE):
        return [directory]
    return [stages_file.folder_of(stages, index, directory) for index in range(len(stages.stages))]


def last_result(directory: Path) -> Path:
    """Return the run folder of the last started stage of a folder of stages; any other folder is returned as it is.

    Raises:
        InputError: the file of stages is malformed.
    """
    if (directory / schema.RECORD).is_file():
        return directory
    return next((run for run in reversed(listed(directory)) if (run / schema.RECORD).is_file()), directory)


def stage_of(run: Path) -> tuple[Stages, int] | None:
    """Return the stages of a run folder and its index among them; None for a folder without stages.

    Raises:
        InputError: the file of stages is malformed.
    """
    out, name = run.resolve().parent, run.resolve().name
    if not stages_file.is_of_run(out / stages_file.FILE):
        return None
    stages = stages_file.read(out / stages_file.FILE)
    names = [stages_file.folder_of(stages, index, out).name for index in range(len(stages.stages))]
    return (stages, names.index(name)) if name in names else None
