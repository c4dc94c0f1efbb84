"""Arrays and views in an anonymous temporary file, so that memory does not grow with the number of photographs."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from unrender.app.capture.capture import CapturedView

_NONE = np.zeros(0, np.float32)


class StoredArrays:
    """Arrays of float32, each read on access.

    Args:
        arrays: consumed one by one.
    """

    def __init__(self, arrays: Iterable[np.ndarray] = ()):
        self._file = tempfile.TemporaryFile(prefix="unrender-")  # noqa: SIM115 (it is open as long as this object exists)
        weakref.finalize(self, self._file.close)
        self._places: list[tuple[int, tuple[int, ...]]] = []
        for array in arrays:
            self.append(array)

    def append(self, array: np.ndarray) -> None:
        """Store one more array."""
        self._places.append((self._file.seek(0, 2), array.shape))
        self._file.write(np.ascontiguousarray(array, np.float32).data)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> np.ndarray:
        offset, shape = self._places[index]
        array = np.empty(shape, np.float32)
        self._file.seek(offset)
        self._file.readinto(array.data.cast("B"))  # pyright: ignore[reportAttributeAccessIssue]
        return array

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self[index] for index in range(len(self)))


class StoredViews:
    """Views with or without masks, each read on access. Names, poses and lenses stay in memory.

    Args:
        views: consumed one by one.
    """

    def __init__(self, views: Iterable[CapturedView] = ()):
        self._values, self._masks, self._shown = StoredArrays(), StoredArrays(), StoredArrays()
        self._views: list[tuple[CapturedView, bool]] = []
        self._indices: Sequence[int] = range(0)
        for view in views:
            self.append(view)

    def append(self, view: CapturedView) -> None:
        """Store one more view."""
        self._values.append(view.values)
        self._masks.append(_NONE if view.mask is None else view.mask)
        self._shown.append(view.shown)
        self._views.append((replace(view, values=_NONE, mask=None, shown=_NONE), view.mask is not None))
        self._indices = range(len(self._views))

    def of(self, held_out: bool) -> StoredViews:
        """Return the held-out or the other views, which share the stored arrays."""
        subset = object.__new__(StoredViews)
        subset.__dict__.update(self.__dict__)
        subset._indices = [index for index in self._indices if self._views[index][0].held_out == held_out]
        return subset

    def bare(self) -> list[CapturedView]:
        """Return all views without masks, and with empty arrays in place of values and coverage."""
        return [self._views[index][0] for index in self._indices]

    @property
    def masked(self) -> list[bool]:
        """True if each view has a mask."""
        return [self._views[index][1] for index in self._indices]

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, position: int) -> CapturedView:
        index = self._indices[position]
        view, masked = self._views[index]
        mask = self._masks[index] if masked else None
        return replace(view, values=self._values[index], mask=mask, shown=self._shown[index])

    def __iter__(self) -> Iterator[CapturedView]:
        return (self[position] for position in range(len(self)))
