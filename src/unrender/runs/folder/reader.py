"""Reading a run folder, and saying in one line what is wrong with one that cannot be read."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from unrender.core.errors import InputError
from unrender.core.suggestions import did_you_mean
from unrender.io import bounded_files
from unrender.runs.folder.history_reader import History, Reader

_FinitePositive = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_Count = Annotated[int, Field(ge=0, lt=2**63)]
_PICTURE = re.compile(r"view([0-9]{1,6})/(reference|initial|result|control_weight|pixel_probability)")


class RunRecord(BaseModel):
    """run.json: what was run and how it ended. Fields beyond these are ignored."""

    model_config = ConfigDict(extra="ignore")

    name: str
    method: str
    seed: Annotated[int, Field(ge=-(2**63), lt=2**63)] = 0
    settings: dict[str, Any] = {}
    command: str | list[str] = ""
    versions: dict[str, Any] = {}
    hardware: dict[str, Any] | str = {}
    variant: str = ""
    stopped: str = ""
    steps: _Count = 0
    seconds: _FinitePositive = 0.0
    warmup_seconds: _FinitePositive = 0.0
    skipped: _Count = 0
    warnings: list[str] = []
    problem: dict[str, Any] = {}


@dataclass(frozen=True)
class ViewPictures:
    """Of one view, each (H, W, 3), linear; the probability with which a pixel is drawn (H, W)."""

    reference: np.ndarray
    result: np.ndarray
    initial: np.ndarray | None = None
    control_weight: np.ndarray | None = None
    pixel_probability: np.ndarray | None = None


@dataclass(frozen=True)
class RunFolder:
    """All of a run folder.

    Attributes:
        path: the folder.
        record: run.json.
        history: history.jsonl.
        parameters, initial, truth: {key: array}; `truth` holds the keys whose truth is known.
        views: {view index: pictures}, ascending; empty where the run kept none.
        error_before, error_after: {key: root mean square error} at the start and at the end, where they are known.
        shapes: {key: shape} of parameters whose arrays here are smaller than those of the run.
    """

    path: Path
    record: RunRecord
    history: History
    parameters: dict[str, np.ndarray]
    initial: dict[str, np.ndarray]
    truth: dict[str, np.ndarray]
    views: dict[int, ViewPictures]
    error_before: dict[str, float] = field(default_factory=dict)
    error_after: dict[str, float] = field(default_factory=dict)
    shapes: dict[str, tuple[int, ...]] = field(default_factory=dict)

    def shape(self, key: str) -> tuple[int, ...]:
        """Of a parameter, as it is in the run."""
        return self.shapes.get(key, self.parameters[key].shape)


def read(directory: str | Path) -> RunFolder:
    """Read and check a run folder.

    Raises:
        InputError: there is none, or a file or field of it is missing or malformed, or leads out of the folder.
    """
    path = Path(directory)
    _check_place(path)
    record = read_record(path / "run.json", path)
    history = Reader(path / "history.jsonl", path).read()
    parameters = bounded_files.arrays(path / "parameters.npz", path)
    initial = bounded_files.arrays(path / "initial.npz", path)
    for key in parameters:
        if key not in initial:
            raise InputError(
                f"{path / 'initial.npz'}: {bounded_files.shown(key)} is missing{did_you_mean(key, map(bounded_files.shown, initial))}"
            )
    truth = _optional(path / "truth.npz", path)
    known = {key: value for key, value in truth.items() if key in parameters}
    before, after = (
        {k: e for k, wanted in known.items() if (e := root_mean_square(of[k], wanted)) is not None}
        for of in (initial, parameters)
    )
    views = pictures_by_view(_optional(path / "pictures.npz", path), path / "pictures.npz")
    return RunFolder(path, record, history, parameters, initial, known, views, before, after)


def root_mean_square(a: np.ndarray, b: np.ndarray) -> float | None:
    """The root mean square difference, or None where the shapes differ (a parameter that was refined on the way)."""
    if a.shape != b.shape or not a.size:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean((a - b) ** 2, dtype=np.float64)))


def _optional(path: Path, folder: Path) -> dict[str, np.ndarray]:
    return bounded_files.arrays(path, folder) if bounded_files.exists(path) else {}


def _check_place(path: Path) -> None:
    if not path.is_dir():
        pair_request = [p.name for p in path.parent.iterdir() if p.is_dir()] if path.parent.is_dir() else []
        what = (
            "is a file, expected a run folder"
            if path.exists()
            else f"no such run folder{did_you_mean(path.name, pair_request)}"
        )
        raise InputError(f"{path}: {what}")
    if not (path / "run.json").is_file():
        inside = sorted(p.parent.name for p in path.glob("*/run.json"))
        hint = f" (run folders inside it: {', '.join(inside[:5])})" if inside else ""
        raise InputError(f"{path}: not a run folder: run.json is missing{hint}")


def read_record(path: Path, folder: Path) -> RunRecord:
    """The record of a run folder. Raises `InputError`."""
    found = bounded_files.parse(bounded_files.text(path, folder), str(path))
    try:
        return RunRecord.model_validate(found)
    except ValidationError as error:
        first = error.errors()[0]
        name = bounded_files.shown(".".join(str(part) for part in first["loc"]))
        if first["type"] == "missing":
            raise InputError(f"{path}: {name} is missing{did_you_mean(name, map(bounded_files.shown, found))}") from error
        message = first["msg"].removeprefix("Input should be ")
        raise InputError(f"{path}: {name}: expected {message}, got {bounded_files.shown(repr(first['input']))}") from error


def pictures_by_view(arrays: dict[str, np.ndarray], path: Path) -> dict[int, ViewPictures]:
    """{"view0/reference": array, ...} by view. Raises `InputError` naming `path`, where they came from."""
    found: dict[int, dict[str, np.ndarray]] = {}
    for name, array in arrays.items():
        match = _PICTURE.fullmatch(name)
        if match is None:
            continue
        if match[2] == "pixel_probability":
            array = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
            if array.ndim != 2 or 0 in array.shape:
                raise InputError(f"{path}: {name}: expected shape (height, width), got {array.shape}")
        elif array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
            raise InputError(f"{path}: {name}: expected shape (height, width, 3), got {array.shape}")
        found.setdefault(int(match[1]), {})[match[2]] = array
    views = {}
    for view, pictures in sorted(found.items()):
        for kind in ("reference", "result"):
            if kind not in pictures:
                raise InputError(f"{path}: view{view}/{kind} is missing")
        shape = pictures["reference"].shape
        for kind, array in pictures.items():
            if array.shape[:2] != shape[:2]:
                raise InputError(
                    f"{path}: view{view}/{kind}: expected the reference's shape {shape}, got {array.shape}"
                )
        views[view] = ViewPictures(**pictures)
    return views
