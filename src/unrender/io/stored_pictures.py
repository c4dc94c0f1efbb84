"""Pictures that wait in a file without a name, so that memory does not grow with their number."""

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
    """One file in the system's folder for temporary files (TMPDIR), which is gone when its pictures are, or the process."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="unrender-")  # noqa: SIM115 (it lives as long as this does)
        weakref.finalize(self, self._file.close)
        self._end = 0

    def add(self, values: np.ndarray) -> StoredPicture:
        """A picture (H, W, ...) of float32, kept exactly: in half as many bytes where 16-bit floats hold it, in a quarter where it has
        256 levels from 0 to 1, as masks have.

        Raises:
            InputError: the file cannot be written, as on a full disk.
        """
        kept, levels = _compact(np.ascontiguousarray(values, np.float32))
        start = -(-self._end // _PAGE) * _PAGE
        try:
            self._file.seek(start)
            self._file.write(kept.data)
            self._file.flush()
        except OSError as error:
            raise InputError(
                f"pictures that wait in {tempfile.gettempdir()}: {error.strerror or error}; TMPDIR names another folder"
            ) from error
        self._end = start + kept.nbytes
        return StoredPicture(self, start, values.shape, kept.dtype, levels)

    def read(self, start: int, size: int) -> bytearray:
        """Some bytes of the file."""
        found, done = bytearray(size), 0
        while done < size:
            read = os.preadv(self._file.fileno(), [memoryview(found)[done:]], start + done)
            if not read:
                raise InputError("pictures that wait in a temporary file: it has been cut short")
            done += read
        return found

    def mapped(self, start: int, size: int) -> mmap.mmap:
        """A part of the file; `start` is that of a picture."""
        return mmap.mmap(self._file.fileno(), size, access=mmap.ACCESS_READ, offset=start)


class StoredPicture:
    """A picture (H, W, ...) of float32, read when it is asked for: `np.asarray` reads all of it, `rows` some pixels.

    Attributes:
        shape, dtype, ndim, size, nbytes: of the array.
    """

    dtype = np.dtype(np.float32)

    def __init__(
        self, store: PictureStore, start: int, shape: tuple[int, ...], kept: np.dtype, levels: np.ndarray | None
    ):
        self.shape, self.ndim = shape, len(shape)
        self.size = int(np.prod(shape))
        self.nbytes = 4 * self.size
        self._store, self._start, self._kept, self._levels = store, start, kept, levels

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise ValueError("a stored picture is read into new memory")
        found = np.frombuffer(self._store.read(self._start, self.size * self._kept.itemsize), self._kept)
        found = self._values(found).reshape(self.shape)
        return found if dtype is None else found.astype(dtype, copy=False)

    def __len__(self) -> int:
        return self.shape[0]

    def rows(self, pixels: np.ndarray) -> np.ndarray:
        """The values of these pixels, (N, C), by row-major indices (N,); C is 1 where the picture has two axes."""
        channels = self.size // (self.shape[0] * self.shape[1])
        with self._store.mapped(self._start, self.size * self._kept.itemsize) as mapped:
            mapped.madvise(mmap.MADV_RANDOM)
            everything = np.frombuffer(mapped, self._kept).reshape(-1, channels)
            found = everything[pixels]
            del everything  # else the file cannot be unmapped
        return self._values(found)

    def _values(self, kept: np.ndarray) -> np.ndarray:
        return kept.astype(np.float32) if self._levels is None else self._levels[kept]


def _compact(values: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """What is written, and what its levels stand for."""
    if values.ndim == 2 and values.size and values.min() >= 0 and values.max() <= 1:
        index = np.rint(values * _LEVELS).astype(np.uint8)
        levels = np.zeros(_LEVELS + 1, np.float32)
        levels[index.ravel()] = values.ravel()
        if np.array_equal(levels[index], values):
            return index, levels
    with np.errstate(over="ignore"):
        half = values.astype(np.float16)
    return (half, None) if np.array_equal(half.astype(np.float32), values) else (values, None)
