"""Images stored in an unnamed temporary file, so that memory does not grow with their number."""

from __future__ import annotations

import mmap
import os
import tempfile
import weakref
from typing import Any

import numpy as np

from unrender.core.errors import InputError

_PAGE = mmap.ALLOCATIONGRANULARITY
_LEVELS = 255


class PictureStore:
    """A file in the folder for temporary files (TMPDIR), which is deleted with its images or with the process."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="unrender-")  # noqa: SIM115 (it lives as long as this does)
        weakref.finalize(self, self._file.close)
        self._end = 0

    def add(self, values: np.ndarray) -> StoredPicture:
        """Store an image (H, W, ...) of float32 without loss.

        It takes half the bytes if 16-bit floats represent it, and a quarter if it has at most 256 levels from 0 to 1, as masks have. Raises
        `InputError` if the file cannot be written, for example because the disk is full.
        """
        stored, levels = _compact(np.ascontiguousarray(values, np.float32))
        start = -(-self._end // _PAGE) * _PAGE
        try:
            self._file.seek(start)
            self._file.write(stored.data)
            self._file.flush()
        except OSError as error:
            raise InputError(
                f"temporary file for pictures in {tempfile.gettempdir()}: {error.strerror or error}; set TMPDIR to another folder"
            ) from error
        self._end = start + stored.nbytes
        return StoredPicture(self, start, values.shape, stored.dtype, levels)

    def read(self, start: int, size: int) -> bytearray:
        """Return `size` bytes of the file from `start`."""
        buffer, done = bytearray(size), 0
        while done < size:
            read = os.preadv(self._file.fileno(), [memoryview(buffer)[done:]], start + done)
            if not read:
                raise InputError("temporary file for pictures: it has been truncated")
            done += read
        return buffer

    def mapped(self, start: int, size: int) -> mmap.mmap:
        """Map a part of the file into memory; `start` is the start of an image."""
        return mmap.mmap(self._file.fileno(), size, access=mmap.ACCESS_READ, offset=start)


class StoredPicture:
    """An image (H, W, ...) of float32 that is read on request: `np.asarray` reads all of it, `rows` reads some pixels."""

    dtype = np.dtype(np.float32)

    def __init__(
        self, store: PictureStore, start: int, shape: tuple[int, ...], stored_type: np.dtype, levels: np.ndarray | None
    ):
        self.shape, self.ndim = shape, len(shape)
        self.size = int(np.prod(shape))
        self.nbytes = 4 * self.size
        self._store, self._start, self._stored_type, self._levels = store, start, stored_type, levels

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise ValueError("a stored picture is read into new memory")
        values = np.frombuffer(self._store.read(self._start, self.size * self._stored_type.itemsize), self._stored_type)
        values = self._values(values).reshape(self.shape)
        return values if dtype is None else values.astype(dtype, copy=False)

    def __len__(self) -> int:
        return self.shape[0]

    def rows(self, pixels: np.ndarray) -> np.ndarray:
        """Return the values of these pixels, (N, C), by row-major indices (N,); C is 1 for an image with two axes."""
        channels = self.size // (self.shape[0] * self.shape[1])
        with self._store.mapped(self._start, self.size * self._stored_type.itemsize) as mapped:
            mapped.madvise(mmap.MADV_RANDOM)
            everything = np.frombuffer(mapped, self._stored_type).reshape(-1, channels)
            values = everything[pixels]
            del everything  # a remaining reference would prevent unmapping
        return self._values(values)

    def _values(self, stored: np.ndarray) -> np.ndarray:
        return stored.astype(np.float32) if self._levels is None else self._levels[stored]


def _compact(values: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the stored array, and the values of its levels if it is quantised."""
    if values.ndim == 2 and values.size and values.min() >= 0 and values.max() <= 1:
        index = np.rint(values * _LEVELS).astype(np.uint8)
        levels = np.zeros(_LEVELS + 1, np.float32)
        levels[index.ravel()] = values.ravel()
        if np.array_equal(levels[index], values):
            return index, levels
    with np.errstate(over="ignore"):
        half = values.astype(np.float16)
    return (half, None) if np.array_equal(half.astype(np.float32), values) else (values, None)
