"""Reader of run folders for resume, report, compare, watch and export, with one-line errors. Nothing in a folder is trusted."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from unrender.core.errors import InputError
from unrender.core.text import did_you_mean, printable
from unrender.io import bounded_files
from unrender.rendering.parameter_errors import ErrorMeasure
from unrender.runs.folder import schema
from unrender.runs.folder.history import History, HistoryReader
from unrender.runs.folder.meshes import RunMesh, meshes_in
from unrender.runs.folder.schema import RunRecord
from unrender.scene.surfaces import Surface, surface_error

_MOST_LISTED = 1000  # maximum number of entries of a folder that are searched for a hint


@dataclass(frozen=True)
class ViewPictures:
    """Images of one view, each (H, W, 3), linear; and the sampling probability of pixels and their weight in [0, 1], each (H, W)."""

    reference: np.ndarray
    result: np.ndarray
    initial: np.ndarray | None = None
    control_weight: np.ndarray | None = None
    pixel_probability: np.ndarray | None = None
    mask: np.ndarray | None = None


@dataclass(frozen=True)
class RunFolder:
    """Contents of a run folder.

    Attributes:
        record: run.json.
        history: history.jsonl.
        parameters, initial, truth: {key: array}; `truth` contains the keys with a known truth.
        views: {view index: images}, ascending; empty if the run saved none.
        error_before, error_after: {key: error} at the start and at the end, if known; see `measure`.
        sensitivity: see `Result.sensitivity`; {} if the run saved none.
        standard_error, data_share: maps of `Result`; {} if the run saved none.
        meshes: {key: `meshes.RunMesh`} of the parameters that are vertex positions.
        shapes: {key: shape} of parameters whose arrays here are smaller than in the run.
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
    sensitivity: dict[str, np.ndarray] = field(default_factory=dict)
    meshes: dict[str, RunMesh] = field(default_factory=dict)
    standard_error: dict[str, np.ndarray] = field(default_factory=dict)
    data_share: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def known(self) -> tuple[str, ...]:
        """Keys of parameters whose error is known: those with a truth, and meshes with a true surface."""
        return (*self.truth, *(key for key in self.error_before if key not in self.truth))

    def measure(self, key: str) -> ErrorMeasure:
        return self.record.problem.measure(key)

    def shape(self, key: str) -> tuple[int, ...]:
        return self.shapes.get(key, self.parameters[key].shape)


def read(directory: str | Path) -> RunFolder:
    """Read a run folder. Raises `InputError` if it, or a file or field of it, is missing, malformed, or outside of the folder."""
    path = Path(directory)
    record = read_run_record(path)
    history = HistoryReader(path / schema.HISTORY, path).read()
    parameters = bounded_files.read_float_arrays(path / schema.PARAMETERS, path)
    initial = bounded_files.read_float_arrays(path / schema.INITIAL, path)
    for key in parameters:
        if key not in initial:
            hint = did_you_mean(key, map(printable, initial))
            raise InputError(f"{path / schema.INITIAL}: {printable(key)} is missing{hint}")
    truth = _optional(path / schema.TRUTH, path)
    known = {key: value for key, value in truth.items() if key in parameters}
    before, after = (
        {
            k: e
            for k, true_value in known.items()
            if (e := record.problem.measure(k).error(of[k], true_value)) is not None
        }
        for of in (initial, parameters)
    )
    meshes = meshes_in(_optional(path / schema.MESHES, path), parameters, initial, path / schema.MESHES)
    for key, mesh in meshes.items():
        for errors, values, faces in ((before, initial, mesh.first_faces), (after, parameters, mesh.faces)):
            if (error := _surface_error(values[key], faces, mesh.truth)) is not None:
                errors[key] = error
    views = pictures_by_view(_optional(path / schema.PICTURES, path), path / schema.PICTURES)
    sensitivity, standard_error, data_share = (
        {k: x for k, x in _optional(path / name, path).items() if k in parameters and x.shape == parameters[k].shape}
        for name in (schema.SENSITIVITY, schema.STANDARD_ERROR, schema.DATA_SHARE)
    )
    maps = sensitivity, meshes, standard_error, data_share
    return RunFolder(path, record, history, parameters, initial, known, views, before, after, {}, *maps)


def read_run_record(folder: Path) -> RunRecord:
    """Return the record of a run folder. Raises `InputError` if the folder is missing or not a run folder, or run.json is malformed."""
    if (kind := bounded_files.kind(folder)) != "folder":
        around = itertools.islice(folder.parent.iterdir(), _MOST_LISTED) if folder.parent.is_dir() else []
        siblings = [p.name for p in around if p.is_dir()]
        what = "a file, expected a run folder" if kind else "no such run folder"
        raise InputError(f"{folder}: {what}{did_you_mean(folder.name, siblings)}")
    if bounded_files.kind(folder / schema.RECORD) != "file":
        inside = sorted(
            p.name for p in itertools.islice(folder.iterdir(), _MOST_LISTED) if (p / schema.RECORD).is_file()
        )
        hint = f" (run folders inside it: {', '.join(inside[:5])})" if inside else ""
        if not hint and (folder / schema.METHOD).is_file() and (folder / schema.LOCK).is_file():
            hint = ": the run was stopped before its first step; start it again with --overwrite"
        raise InputError(f"{folder}: not a run folder: {schema.RECORD} is missing{hint}")
    return read_record(folder / schema.RECORD, folder)


def read_record(path: Path, folder: Path) -> RunRecord:
    """Return the record in a file of a run folder. Raises `InputError`."""
    return schema.validate(RunRecord, bounded_files.read_object(path, folder), str(path))


def _surface_error(values: np.ndarray, faces: np.ndarray, truth: Surface | None) -> float | None:
    """Return the distance of a mesh from its true surface; None if there is none, or the mesh is not a surface."""
    if truth is None:
        return None
    try:
        return surface_error(Surface(values.reshape(-1, 3), faces), truth)
    except (InputError, ValueError):
        return None


def pictures_by_view(arrays: dict[str, np.ndarray], path: Path) -> dict[int, ViewPictures]:
    """Group {"view0/reference": array, ...} by view. Raises `InputError` that names `path`, their file."""
    by_view: dict[int, dict[str, np.ndarray]] = {}
    for name, array in arrays.items():
        match = schema.PICTURE_NAME.fullmatch(name)
        if match is None:
            continue
        if match[2] in ("pixel_probability", "mask"):
            array = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
            if array.ndim != 2 or 0 in array.shape:
                raise InputError(f"{path}: {name}: expected shape (height, width), got {array.shape}")
            if match[2] == "mask" and not (array.min() >= 0 and 0 < array.max() <= 1):
                raise InputError(f"{path}: {name}: expected numbers from 0 to 1, not all 0")
        elif array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
            raise InputError(f"{path}: {name}: expected shape (height, width, 3), got {array.shape}")
        by_view.setdefault(int(match[1]), {})[match[2]] = array
    views = {}
    for view, pictures in sorted(by_view.items()):
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


def _optional(path: Path, folder: Path) -> dict[str, np.ndarray]:
    return bounded_files.read_float_arrays(path, folder) if bounded_files.exists(path) else {}
