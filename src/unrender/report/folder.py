"""Reading a run folder, and saying in one line what is wrong with one that cannot be read."""

from __future__ import annotations

import json
import math
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from unrender import files
from unrender.errors import InputError
from unrender.names import did_you_mean

_FinitePositive = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_PICTURE = re.compile(r"view(\d+)/(reference|initial|result|control_weight)")


class RunRecord(BaseModel):
    """run.json: what was run and how it ended. Fields beyond these are ignored."""

    model_config = ConfigDict(extra="ignore")

    name: str
    method: str
    seed: int = 0
    settings: dict[str, Any] = {}
    command: str | list[str] = ""
    versions: dict[str, Any] = {}
    hardware: dict[str, Any] | str = {}
    variant: str = ""
    stopped: str = ""
    steps: Annotated[int, Field(ge=0)] = 0
    seconds: _FinitePositive = 0.0
    warmup_seconds: _FinitePositive = 0.0
    skipped: Annotated[int, Field(ge=0)] = 0
    warnings: list[str] = []
    problem: dict[str, Any] = {}


@dataclass(frozen=True)
class ErrorHistory:
    """One parameter's root mean square error where it was recorded; arrays of equal length.

    Attributes:
        records: which of the history's records, ascending.
        values: >= 0; infinite where the record holds no number.
    """

    records: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class History:
    """history.jsonl, by columns of one length.

    Attributes:
        seconds, samples: since the start, ascending.
        loss, gradient_noise: NaN where the record holds no number.
        parameter_error: {key: where and what}.
    """

    seconds: np.ndarray
    samples: np.ndarray
    loss: np.ndarray
    gradient_noise: np.ndarray
    parameter_error: dict[str, ErrorHistory]

    def __len__(self) -> int:
        return len(self.seconds)


@dataclass(frozen=True)
class ViewPictures:
    """Of one view, each (H, W, 3), linear."""

    reference: np.ndarray
    result: np.ndarray
    initial: np.ndarray | None
    control_weight: np.ndarray | None


@dataclass(frozen=True)
class RunFolder:
    """All of a run folder.

    Attributes:
        path: the folder.
        record: run.json.
        history: history.jsonl.
        parameters, initial, truth: {key: array}; `truth` holds the keys whose truth is known.
        views: {view index: pictures}, ascending; empty where the run kept none.
    """

    path: Path
    record: RunRecord
    history: History
    parameters: dict[str, np.ndarray]
    initial: dict[str, np.ndarray]
    truth: dict[str, np.ndarray]
    views: dict[int, ViewPictures]


def read(directory: str | Path) -> RunFolder:
    """Read and check a run folder.

    Raises:
        InputError: there is none, or a file or field of it is missing or malformed.
    """
    path = Path(directory)
    _check_place(path)
    record = _read_record(path / "run.json")
    history = _read_history(path / "history.jsonl")
    parameters = _read_arrays(path / "parameters.npz")
    initial = _read_arrays(path / "initial.npz")
    for key in parameters:
        if key not in initial:
            raise InputError(f"{path / 'initial.npz'}: {key} is missing{did_you_mean(key, initial)}")
    truth = _read_arrays(path / "truth.npz") if (path / "truth.npz").exists() else {}
    views = _read_pictures(path / "pictures.npz") if (path / "pictures.npz").exists() else {}
    known = {key: value for key, value in truth.items() if key in parameters}
    return RunFolder(path, record, history, parameters, initial, known, views)


def _check_place(path: Path) -> None:
    if not path.is_dir():
        beside = [p.name for p in path.parent.iterdir() if p.is_dir()] if path.parent.is_dir() else []
        what = (
            "is a file, expected a run folder"
            if path.exists()
            else f"no such run folder{did_you_mean(path.name, beside)}"
        )
        raise InputError(f"{path}: {what}")
    if not (path / "run.json").is_file():
        inside = sorted(p.parent.name for p in path.glob("*/run.json"))
        hint = f" (run folders inside it: {', '.join(inside[:5])})" if inside else ""
        raise InputError(f"{path}: not a run folder: run.json is missing{hint}")


def _parse(text: str, where: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except json.JSONDecodeError as error:
        line = f":{error.lineno}" if error.lineno > 1 else ""
        raise InputError(f"{where}{line}: not JSON: {error.msg} at column {error.colno}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: not JSON that can be read: {error}") from error
    if not isinstance(found, dict):
        raise InputError(f"{where}: expected an object {{...}}, got {type(found).__name__}")
    return found


def _read_record(path: Path) -> RunRecord:
    found = _parse(files.read_text(path), str(path))
    try:
        return RunRecord.model_validate(found)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        if first["type"] == "missing":
            raise InputError(f"{path}: {field} is missing{did_you_mean(field, found)}") from error
        message = first["msg"].removeprefix("Input should be ")
        raise InputError(f"{path}: {field}: expected {message}, got {_short(first['input'])}") from error


def _read_history(path: Path) -> History:
    columns: dict[str, list[float]] = {"seconds": [], "samples": [], "loss": [], "gradient_noise": []}
    errors: dict[str, tuple[list[int], list[float]]] = {}
    last = {"seconds": 0.0, "samples": 0.0}
    for number, line in enumerate(files.read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        where = f"{path}:{number}"
        record = _parse(line, where)
        for name, column in columns.items():
            required = name in last
            value = _number(record.get(name), f"{where}: {name}", required)
            if required:
                if value < last[name]:
                    raise InputError(f"{where}: {name}: expected no less than {last[name]:g} before it, got {value:g}")
                last[name] = value
            column.append(value)
        found = record.get("parameter_error", {})
        if not isinstance(found, dict):
            raise InputError(f"{where}: parameter_error: expected an object {{key: number}}, got {_short(found)}")
        for key, value in found.items():
            records, values = errors.setdefault(key, ([], []))
            records.append(len(columns["seconds"]) - 1)
            error = _number(value, f"{where}: parameter_error.{key}", False)
            values.append(error if math.isfinite(error) else math.inf)
    return History(
        **{name: np.array(column, float) for name, column in columns.items()},
        parameter_error={key: ErrorHistory(np.array(r, int), np.array(v, float)) for key, (r, v) in errors.items()},
    )


def _number(value: Any, where: str, required: bool) -> float:
    if value is None and not required:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: expected a number, got {_short(value)}")
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if required and not math.isfinite(found):
        raise InputError(f"{where}: expected a finite number, got {value}")
    return found if math.isfinite(found) else math.nan


def _short(value: Any) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz file, real numbers only, as floats. Pickled objects are refused."""
    if not path.exists():
        raise InputError(f"{path}: the file is missing")
    name = ""
    try:
        with path.open("rb") as opened:
            file = np.load(opened, allow_pickle=False)
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise InputError(f"{path}: expected an .npz archive of arrays")
            found = {}
            for name in file.files:
                array = file[name]
                if array.dtype.kind not in "fiub":
                    raise InputError(f"{path}: {name}: expected real numbers, got {array.dtype}")
                found[name] = array.astype(np.result_type(array, np.float32))
            return found
    except (InputError, MemoryError):
        raise
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zipfile.LargeZipFile, RuntimeError) as error:
        field = f" {name}:" if name else ""
        raise InputError(f"{path}:{field} not an .npz archive that can be read ({type(error).__name__})") from error


def _read_pictures(path: Path) -> dict[int, ViewPictures]:
    found: dict[int, dict[str, np.ndarray]] = {}
    for name, array in _read_arrays(path).items():
        match = _PICTURE.fullmatch(name)
        if match is None:
            continue
        if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
            raise InputError(f"{path}: {name}: expected shape (height, width, 3), got {array.shape}")
        found.setdefault(int(match[1]), {})[match[2]] = array
    views = {}
    for view, pictures in sorted(found.items()):
        for kind in ("reference", "result"):
            if kind not in pictures:
                raise InputError(f"{path}: view{view}/{kind} is missing")
        shape = pictures["reference"].shape
        for kind, array in pictures.items():
            if array.shape != shape:
                raise InputError(
                    f"{path}: view{view}/{kind}: expected the reference's shape {shape}, got {array.shape}"
                )
        views[view] = ViewPictures(
            pictures["reference"], pictures["result"], pictures.get("initial"), pictures.get("control_weight")
        )
    return views
