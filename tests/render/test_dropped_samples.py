"""Counts of samples that are not finite are exact, and are read seldom, since each reading waits for all launches before it."""

import logging

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from unrender.rendering.mitsuba.camera_paths import DroppedSamples

pytestmark = pytest.mark.mitsuba
_LAUNCHES = 400


def _launch(dropped: DroppedSamples, broken: int) -> np.ndarray:
    """Develop four pixels of two samples each, of which the first `broken` samples are no numbers."""
    values = np.ones((3, 8), np.float32)
    values[1, :broken] = np.nan
    radiance = mi.Color3f(values)
    dr.eval(radiance)
    return np.array(dropped.develop(radiance, 2, 1, (2, 2, 3)))


def test_counts_are_exact_and_read_seldom(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    reads = []
    read = DroppedSamples.read
    monkeypatch.setattr(DroppedSamples, "read", lambda self: (reads.append(len(self._pending)), read(self)))
    dropped = DroppedSamples(at_once=False)
    with caplog.at_level(logging.WARNING, "unrender"):
        image = _launch(dropped, 3)
        _launch(dropped, 0)
        _launch(dropped, 0)
        assert "3 of 8 so far were dropped" in caplog.text or "3 of 16 so far were dropped" in caplog.text
    np.testing.assert_allclose(image[0, :, :, 0].ravel(), [0, 0.5, 1, 1])
    for _ in range(_LAUNCHES):
        _launch(dropped, 1)
    assert len(reads) < _LAUNCHES / 8
    assert dropped.count == 3 + _LAUNCHES


def test_counts_are_read_at_once_where_asked(caplog: pytest.LogCaptureFixture) -> None:
    dropped = DroppedSamples(at_once=True)
    with caplog.at_level(logging.WARNING, "unrender"):
        _launch(dropped, 2)
    assert "2 of 8 so far were dropped" in caplog.text
