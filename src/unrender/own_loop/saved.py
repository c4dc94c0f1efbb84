"""State of a `Renderer` as a file: tensors in safetensors format, with their structure in its header."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
import safetensors.numpy

from unrender.core.errors import InputError
from unrender.io import bounded_files, files
from unrender.own_loop.stream import StreamState
from unrender.runs.folder.state import Packed, pack, unpack

_FORMAT = "unrender.Renderer 1"
_LARGEST = 1 << 36
_HEADER = "__metadata__"


@dataclass(frozen=True)
class RendererState:
    """State of a `Renderer` between steps.

    Attributes:
        step: number of renders so far.
        streams: {index of the sensor as text, or "mini-batches": its state}.
    """

    step: int
    seed: int
    streams: dict[str, StreamState]


def write(path: Path, state: RendererState, options: dict[str, Any]) -> Path:
    """Write a state and its options, and return the path. Raises `InputError` if they cannot be written."""
    packed = pack(state)
    notes = {"format": _FORMAT, "options": json.dumps(options), "state": json.dumps(packed.skeleton, allow_nan=False)}
    return files.write(path, safetensors.numpy.save(packed.tensors, metadata=notes), durable=True)


def read(path: Path, options: dict[str, Any], pattern: RendererState) -> RendererState:
    """Return the state in a file.

    Args:
        path: file of `write`.
        options: options that the file must have.
        pattern: a state with the same components.

    Raises:
        InputError: the file is damaged, or has other options.
    """
    size = path.stat().st_size if path.is_file() else 0
    data = bounded_files.read_bytes(path, min(size, _LARGEST), path.parent)
    length = int.from_bytes(data[:8], "little")
    header = bounded_files.parse_json(data[8 : 8 + min(length, len(data))], f"{path}: header")
    notes = header.get(_HEADER) if isinstance(header, dict) else None
    if not isinstance(notes, dict) or notes.get("format") != _FORMAT:
        raise InputError(f"{path}: not the state of a Renderer, as Renderer.save writes it")
    _check_options(path, bounded_files.parse_json(str(notes.get("options")).encode(), f"{path}: options"), options)
    skeleton = bounded_files.parse_json(str(notes.get("state")).encode(), f"{path}: state")
    try:
        tensors = {name: array.copy() for name, array in safetensors.numpy.load(data).items()}
    except (safetensors.SafetensorError, KeyError) as error:
        raise InputError(f"{path}: tensors cannot be read: {str(error)[:200]}") from error
    try:
        state = unpack(Packed(skeleton, tensors), [pattern])
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if not _fits(state, pattern):
        raise InputError(f"{path}: not the state of a Renderer with these options")
    return state


def _check_options(path: Path, saved: Any, options: dict[str, Any]) -> None:
    if not isinstance(saved, dict):
        raise InputError(f"{path}: options: expected an object, got {saved!r:.60}")
    for name, value in options.items():
        if saved.get(name) != value:
            raise InputError(
                f"{path}: it is of a Renderer with {name}={saved.get(name)!r:.120}, this one has {value!r:.120}"
            )


def _fits(state: Any, pattern: RendererState) -> bool:
    if not isinstance(state, RendererState) or not isinstance(state.streams, dict):
        return False
    known = next(iter(pattern.streams.values()))
    numbers = (state.step, state.seed)
    if any(isinstance(n, bool) or not isinstance(n, int) or n < 0 for n in numbers):
        return False
    names = state.streams.keys()
    if any(name not in pattern.streams and not (isinstance(name, str) and name.isdecimal()) for name in names):
        return False
    return all(
        isinstance(stream, StreamState)
        and type(stream.image) is type(known.image)
        and type(stream.pixels) is type(known.pixels)
        and type(stream.coupled) is type(known.coupled)
        for stream in state.streams.values()
    )
