"""Checkpoints: `checkpoints/<step>/state.safetensors` and `manifest.json`, none of which is ever seen half-written.

A checkpoint is written into a folder of another name; its manifest comes last and is on the disk before the folder gets its name.
What is removed loses its manifest first. So whatever instant a process dies at, all folders with a name and a manifest are whole.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
import safetensors
import safetensors.numpy
from pydantic import BaseModel, ConfigDict, Field, StrictInt, StrictStr

from unrender.io import files
from unrender.core.errors import InputError
from unrender.runs.folder.state import Packed

FOLDER, STATE, MANIFEST = "checkpoints", "state.safetensors", "manifest.json"
KEPT = 3
_NAME = re.compile(r"\d{8,12}")
_LONGEST_MANIFEST = 1 << 24
_LARGEST_STATE = 1 << 36
_FORMAT = 1


class Manifest(BaseModel):
    """manifest.json.

    Attributes:
        format: of the checkpoint.
        step: how many steps were done.
        seed: the run's.
        size, sha256: of state.safetensors.
        versions: of what decides the numbers.
        problem: the problem's fingerprint.
        state: how the tensors are put together, see `state.py`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1]
    step: Annotated[StrictInt, Field(ge=0)]
    seed: StrictInt
    size: Annotated[StrictInt, Field(ge=0)]
    sha256: Annotated[StrictStr, Field(pattern=r"^[0-9a-f]{64}$")]
    versions: dict[StrictStr, StrictStr]
    problem: dict[StrictStr, StrictStr]
    state: Any


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint that was read, its state still in parts."""

    manifest: Manifest
    packed: Packed


def write(
    folder: Path,
    step: int,
    seed: int,
    packed: Packed,
    versions: Mapping[str, str],
    problem: Mapping[str, str],
    kept: int = KEPT,
) -> Path:
    """Write a checkpoint of the run folder `folder`, then remove all but the last `kept`. Raises `OSError` where that fails, and leaves
    the earlier ones as they were."""
    place = folder / FOLDER
    pair_request, there = place / f".{step:08d}.{os.getpid()}.part", place / f"{step:08d}"
    data = safetensors.numpy.save(packed.tensors)
    manifest = {
        "format": _FORMAT,
        "step": step,
        "seed": seed,
        "size": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
        "versions": dict(versions),
        "problem": dict(problem),
        "state": packed.skeleton,
    }
    try:
        _remove(pair_request)
        pair_request.mkdir(parents=True)
        _write(pair_request / STATE, data)
        _write(pair_request / MANIFEST, json.dumps(manifest, allow_nan=False).encode())
        files.sync_folder(pair_request)
        _remove(there)
        pair_request.rename(there)
        files.sync_folder(place)
    except OSError:
        _remove(pair_request)
        raise
    for old in _named(place)[:-kept]:
        _remove(old)
    return there


def newest(folder: Path, fits: Callable[[Checkpoint], str] = lambda _: "") -> tuple[Checkpoint | None, list[str]]:
    """The newest checkpoint of a run folder that can be read and that `fits` (which says why not, in words); None where there is none.
    And one line for each that was passed over.

    Raises:
        InputError: there are some, but none can be read.
    """
    place = folder / FOLDER
    if place.is_symlink():
        raise InputError(f"{place}: a link, expected a folder")
    passed: list[str] = []
    for path in reversed(_named(place)):
        try:
            found = read(path)
            if reason := fits(found):
                raise InputError(f"{path}: {reason}")
            return found, passed
        except InputError as error:
            passed.append(str(error))
    if passed:
        raise InputError(passed[0])
    return None, []


def read(path: Path) -> Checkpoint:
    """The checkpoint in a folder. Raises `InputError` for what is none: one line that says which file, and what is wrong."""
    if path.is_symlink() or any((path / name).is_symlink() for name in (STATE, MANIFEST)):
        raise InputError(f"{path}: a link, or with links inside; expected a folder with files")
    where = str(path / MANIFEST)
    given = files.parse_json(files.read_bytes(path / MANIFEST, _LONGEST_MANIFEST), where)
    try:
        manifest = Manifest.model_validate(given)
    except (pydantic.ValidationError, RecursionError) as error:
        raise InputError(f"{where}: {_explain(error)}") from error
    if int(path.name) != manifest.step:
        raise InputError(f"{where}: step: expected {int(path.name)}, as its folder is named, got {manifest.step}")
    return Checkpoint(manifest, Packed(manifest.state, _tensors(path / STATE, manifest)))


def clear(folder: Path) -> None:
    """Remove all checkpoints of a run folder, those that were never finished among them. Links are removed, not followed."""
    place = folder / FOLDER
    if place.is_symlink():
        place.unlink()
    elif place.is_dir():
        for path in place.iterdir():
            _remove(path)
        place.rmdir()


def sweep(folder: Path) -> None:
    """Remove what runs that died left unfinished. For the process that holds the folder."""
    place = folder / FOLDER
    for path in (*folder.glob("*.part"), *(place.glob(".*.part") if not place.is_symlink() else ())):
        _remove(path)


def _explain(error: Exception) -> str:
    if not isinstance(error, pydantic.ValidationError):
        return "nested too deeply"
    first = error.errors(include_url=False, include_input=True)[0]
    field = ".".join(str(part) for part in first["loc"]) or "manifest"
    return f"{field[:80]}: {first['msg'].lower()}, got {repr(first['input'])[:60]}"


def _tensors(path: Path, manifest: Manifest) -> dict[str, Any]:
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if size != manifest.size:
        raise InputError(f"{path}: expected {manifest.size} bytes, as the manifest says, got {size}")
    data = files.read_bytes(path, min(manifest.size, _LARGEST_STATE))
    if hashlib.sha256(data).hexdigest() != manifest.sha256:
        raise InputError(f"{path}: not what was written: its SHA-256 is not the manifest's")
    header = files.parse_json(data[8 : 8 + min(int.from_bytes(data[:8], "little"), len(data))], f"{path}: header")
    if not isinstance(header, dict):
        raise InputError(f"{path}: not tensors that can be read: its header is no object")
    try:
        # Checks every type, shape and offset against the bytes that are there before it takes memory for any.
        return {name: array.copy() for name, array in safetensors.numpy.load(data).items()}
    except safetensors.SafetensorError as error:
        raise InputError(f"{path}: not tensors that can be read: {str(error)[:200]}") from error
    except KeyError as error:
        raise InputError(f"{path}: tensors of type {error}, which no state has") from error


def _named(place: Path) -> list[Path]:
    """The finished checkpoints, oldest first."""
    if not place.is_dir():
        return []
    found = [path for path in place.iterdir() if _NAME.fullmatch(path.name)]
    return sorted(
        (path for path in found if (path / MANIFEST).exists() or path.is_symlink()), key=lambda p: int(p.name)
    )


def _write(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _remove(path: Path) -> None:
    """Whatever is there; a checkpoint's manifest first, so that half of one is none."""
    if path.is_symlink() or path.is_file():
        path.unlink(missing_ok=True)
        return
    (path / MANIFEST).unlink(missing_ok=True)
    shutil.rmtree(path, ignore_errors=True)
