"""Videos of frames: .mp4, .gif, or a folder of PNG files."""

from __future__ import annotations

import importlib.util
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from unrender.core.errors import InputError
from unrender.io import files

ENDINGS = (".mp4", ".gif", "")
"""Supported file name extensions; "" is a folder."""
_QUALITY = 8


def has_ffmpeg() -> bool:
    """Return whether .mp4 files can be written."""
    return importlib.util.find_spec("imageio_ffmpeg") is not None


def check(path: Path, overwrite: bool) -> None:
    """Raise `InputError` if a video cannot be written to `path`."""
    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"--out {path}: expected a name that ends in .mp4 or .gif, or the name of a folder")
    if path.suffix.lower() == ".mp4" and not has_ffmpeg():
        raise InputError(f"--out {path}: .mp4 needs imageio-ffmpeg: pip install 'unrender[capture]'; .gif does not")
    try:
        if path.is_dir() and path.suffix:
            raise InputError(f"--out {path}: a folder, expected a file's name")
        if path.is_dir() and any(not _is_frame(each) for each in path.iterdir()):
            raise InputError(f"--out {path}: the folder contains other files; give a new folder")
        if path.is_file() and not path.suffix:
            raise InputError(f"--out {path}: a file, expected a folder's name")
        if (path.is_file() or (path.is_dir() and any(path.iterdir()))) and not overwrite:
            raise InputError(f"--out {path}: exists; give --overwrite to replace it")
        there = next(each for each in (path.parent, *path.absolute().parents) if each.exists())
        if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
            raise InputError(f"--out {path}: {there} is not a folder that can be written to")
    except OSError as error:
        raise InputError(f"--out {path}: {error.strerror or error}") from error


def write(path: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    """Write frames (H, W, 3), bytes, of even width and height, at `rate` frames per second, in the order of their arrival.

    Raises:
        InputError: the video cannot be written.
    """
    ending = path.suffix.lower()
    try:
        if not ending:
            files.remove_leftovers(path.parent, (path.name,))
            files.write_folder(path, lambda folder: _write_frames(folder, frames))
            return
        with tempfile.TemporaryDirectory() as scratch:
            file = Path(scratch) / f"video{ending}"
            (_write_gif if ending == ".gif" else _write_mp4)(file, frames, rate)
            files.write(path, file.read_bytes())
    except OSError as error:
        raise InputError(f"--out {path}: {error.strerror or error}") from error


def _is_frame(path: Path) -> bool:
    return path.suffix == ".png" and path.stem.isdigit()


def _write_frames(folder: Path, frames: Iterable[np.ndarray]) -> None:
    for index, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / f"{index:04d}.png")


def _write_gif(path: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    pictures = [Image.fromarray(frame).quantize(256) for frame in frames]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=round(1000 / rate), loop=0)


def _write_mp4(path: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    import imageio_ffmpeg

    write_frames: Any = imageio_ffmpeg.write_frames
    sink = None
    try:
        for frame in frames:
            if sink is None:
                size = frame.shape[1], frame.shape[0]
                sink = write_frames(
                    str(path), size, fps=rate, quality=_QUALITY, macro_block_size=2, ffmpeg_log_level="error"
                )
                sink.send(None)
            sink.send(np.ascontiguousarray(frame))
    finally:
        if sink is not None:
            sink.close()
