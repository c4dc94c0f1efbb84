"""Atomic checkpoints: `checkpoints/<step>/state.safetensors` and `manifest.json`.

A checkpoint is written to a folder with a temporary name. Its manifest comes last, and is on disk before the folder is renamed. Removal
deletes the manifest first. So at every instant, each folder with a checkpoint's name and a manifest is complete.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
import safetensors.numpy

from unrender.core.errors import InputError
from unrender.io import bounded_files, files
from unrender.runs.folder import schema
from unrender.runs.folder.schema import CHECKPOINTS, MANIFEST, STATE, Manifest
from unrender.runs.folder.state import Packed

FOLDER = CHECKPOINTS
KEEP = 3
"""Maximum number of checkpoints in a run folder."""
_NAME = re.compile(r"\d{8,12}")
_LARGEST_MANIFEST = 1 << 24
_LARGEST_STATE = 1 << 36
_FORMAT = 1


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint as read, with its state still packed."""

    manifest: Manifest
    packed: Packed


def write(
    folder: Path,
    step: int,
    seed: int,
    packed: Packed,
    versions: Mapping[str, str],
    problem: Mapping[str, str],
    keep: int = KEEP,
) -> Path:
    """Write a checkpoint of the run folder, then remove all but the last `keep`. Raises `OSError`, and leaves earlier ones unchanged."""
    root = folder / FOLDER
    partial, final = root / f".{step:08d}.{os.getpid()}.{files.PARTIAL}", root / f"{step:08d}"
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
        _remove(partial)
        files.make_folder(root)
        partial.mkdir()
        _write(partial / STATE, data)
        _write(partial / MANIFEST, json.dumps(manifest, allow_nan=False).encode())
        if final.is_dir() and not final.is_symlink():
            files.replace_folder(partial, final)
        else:
            _remove(final)
            files.sync_folder(partial)
            partial.rename(final)
            files.sync_folder(root)
    except OSError:
        _remove(partial)
        raise
    for old in _finished(root)[:-keep]:
        _remove(old)
    return final


def candidates(
    folder: Path, reject: Callable[[Checkpoint], str] = lambda _: ""
) -> Iterator[tuple[Checkpoint | None, list[str]]]:
    """Yield the readable checkpoints of a run folder that `reject` returns "" for, latest first; None alone if there are none.

    Each comes with one line for every later one that was skipped, in a list to which the caller may add why it skips this one. Raises
    `InputError`, the message of the latest, if all existing checkpoints were skipped.
    """
    root = folder / FOLDER
    if root.is_symlink():
        raise InputError(f"{root}: a link, expected a folder")
    passed_over: list[str] = []
    finished = _finished(root)
    for path in reversed(finished):
        try:
            one = read(path)
            if reason := reject(one):
                raise InputError(f"{path}: {reason}")
        except InputError as error:
            passed_over.append(str(error))
            continue
        yield one, passed_over
    if passed_over:
        raise InputError(passed_over[0])
    if not finished:
        yield None, []


def read(path: Path) -> Checkpoint:
    """Read the checkpoint in a folder. Raises `InputError` with the file and the fault."""
    if path.is_symlink() or any((path / name).is_symlink() for name in (STATE, MANIFEST)):
        raise InputError(f"{path}: a link, or with links inside; expected a folder with files")
    where = str(path / MANIFEST)
    content = bounded_files.parse_json(bounded_files.read_bytes(path / MANIFEST, _LARGEST_MANIFEST, path), where)
    manifest = schema.validate(Manifest, content, where)
    if int(path.name) != manifest.step:
        raise InputError(f"{where}: step: expected {int(path.name)}, as its folder is named, got {manifest.step}")
    return Checkpoint(manifest, Packed(manifest.state, _tensors(path / STATE, manifest)))


def clear(folder: Path) -> None:
    """Remove all checkpoints of a run folder, including unfinished ones. Links are removed, not followed."""
    root = folder / FOLDER
    if root.is_symlink():
        root.unlink()
    elif root.is_dir():
        for path in root.iterdir():
            _remove(path)
        root.rmdir()


def remove_partial(folder: Path) -> None:
    """Remove checkpoints that dead processes left half-written or half-removed. Only for the process that holds the folder's lock."""
    root = folder / FOLDER
    if root.is_symlink() or not root.is_dir():
        return
    files.remove_leftovers(root)
    for path in root.iterdir():
        if _NAME.fullmatch(path.name) and path.is_dir() and not path.is_symlink() and not (path / MANIFEST).exists():
            _remove(path)


def _tensors(path: Path, manifest: Manifest) -> dict[str, Any]:
    with files.input_errors(f"{path}: cannot be read"):
        size = path.stat().st_size
    if size != manifest.size:
        raise InputError(f"{path}: expected {manifest.size} bytes, as the manifest says, got {size}")
    data = bounded_files.read_bytes(path, min(manifest.size, _LARGEST_STATE), path.parent)
    if hashlib.sha256(data).hexdigest() != manifest.sha256:
        raise InputError(f"{path}: not what was written: its SHA-256 is not the manifest's")
    header = bounded_files.parse_json(
        data[8 : 8 + min(int.from_bytes(data[:8], "little"), len(data))], f"{path}: header"
    )
    if not isinstance(header, dict):
        raise InputError(f"{path}: tensors cannot be read: its header is not an object")
    try:
        # safetensors checks every type, shape and offset against the available bytes before it allocates memory.
        return {name: array.copy() for name, array in safetensors.numpy.load(data).items()}
    except safetensors.SafetensorError as error:
        raise InputError(f"{path}: tensors cannot be read: {str(error)[:200]}") from error
    except KeyError as error:
        raise InputError(f"{path}: tensors of type {error}, which no state has") from error


def _finished(root: Path) -> list[Path]:
    if not root.is_dir():
        return []
    named = [path for path in root.iterdir() if _NAME.fullmatch(path.name)]
    return sorted(
        (path for path in named if (path / MANIFEST).exists() or path.is_symlink()), key=lambda p: int(p.name)
    )


def _write(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        files.flush(file.fileno())


def _remove(path: Path) -> None:
    """Remove a path; of a checkpoint the manifest first, so that a partial one is never valid."""
    if path.is_symlink() or path.is_file():
        path.unlink(missing_ok=True)
        return
    (path / MANIFEST).unlink(missing_ok=True)
    shutil.rmtree(path, ignore_errors=True)
