"""Writing of a result's files in a run folder, for `RunWriter` during a run and for `Result.save`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unrender.backend.variant import current
from unrender.backend.versions import hardware, versions
from unrender.core.text import plain
from unrender.io import files
from unrender.runs.folder import history, schema
from unrender.runs.image_sensitivity import MAP_AXES

if TYPE_CHECKING:
    from unrender.runs.result import Result

_ALWAYS = (schema.PARAMETERS, schema.INITIAL)  # archives that exist even without arrays
_COPIED = (
    *("name", "method", "choices", "seed", "command", "steps", "seconds", "warmup_seconds", "skipped", "resumed"),
    *("undetermined", "without_errors"),
)
"""Fields of run.json that are those of the result."""


def check_writable(folder: Path, result: Result, status: str) -> None:
    """Raise `InputError` if the reader would reject the files of this result."""
    encoded_record(folder, result, status)
    for key in result.parameters:
        files.check_member(key, f"run folder {folder}: parameter")


def write_arrays(folder: Path, result: Result, names: Sequence[str] = ()) -> None:
    """Write the archives of a result, by default all, and remove those of an earlier end without contents. Names are not yet on disk."""
    archives = {
        schema.PARAMETERS: result.parameters,
        schema.INITIAL: result.initial,
        schema.TRUTH: result.truth,
        schema.PICTURES: result.pictures,
        schema.SENSITIVITY: result.sensitivity,
        schema.STANDARD_ERROR: {key: x for key, x in result.standard_error.items() if np.ndim(x) >= MAP_AXES},
        schema.DATA_SHARE: result.data_share,
        schema.MESHES: result.meshes,
        schema.LAST: {} if result.last is result.parameters else result.last,
    }
    for name in names or archives:
        if archives[name] or name in _ALWAYS:
            files.write_arrays(folder / name, archives[name], name_too=False)
        else:
            (folder / name).unlink(missing_ok=True)


def write_record(folder: Path, result: Result, status: str, error: str = "") -> None:
    """Write run.json."""
    files.write(folder / schema.RECORD, encoded_record(folder, result, status, error))


def write_result(folder: Path, result: Result, status: str) -> None:
    """Write history, arrays and, last, run.json, each atomically and on disk. Raises `InputError` if that or reading it would fail."""
    check_writable(folder, result, status)
    with files.input_errors(f"run folder {folder}: cannot be written"):
        files.make_folder(folder)
        write_arrays(folder, result)
        files.write(folder / schema.HISTORY, history.lines(result.history), name_too=False)
        files.sync_folder(folder)
        write_record(folder, result, status)


def encoded_record(folder: Path, result: Result, status: str, error: str = "") -> bytes:
    """Return the bytes of run.json. Raises `InputError` if the reader would reject them."""
    return schema.encode(schema.RunRecord, record(result, status, error), str(folder / schema.RECORD))


def record(result: Result, status: str, error: str = "") -> dict[str, Any]:
    """Return the contents of run.json, see `schema.RunRecord`, of a run that failed by the exception `error`, "" for none."""
    if status == "failed" and not error:
        error = "stopped: the last gradients were not finite"
    fields: dict[str, Any] = {
        "status": status,
        **{name: getattr(result, name) for name in _COPIED},
        "settings": dict(result.settings),
        "adapted": [plain(line) for line in result.adapted],
        "versions": versions(),
        "hardware": hardware(),
        "variant": current() or "",
        "stopped": plain(result.stopped),
        "warnings": [plain(line) for line in result.warnings],
        "problem": dict(result.problem),
        "image_errors": {name: list(error) for name, error in result.image_errors.items() if np.isfinite(error).all()},
        "standard_error": {
            key: [float(f"{value:.6g}") if np.isfinite(value) else None for value in np.ravel(error)]
            for key, error in result.standard_error.items()
            if np.ndim(error) < MAP_AXES
        },
        "verification": dict(result.verification),
        "misfit": result.misfit.record() if result.misfit else {},
        "phases": {name: round(seconds, 3) for name, seconds in result.phases.items()},
    }
    if error:
        fields["error"] = plain(error)
    return schema.serialize(schema.RunRecord.model_construct(None, **fields))
