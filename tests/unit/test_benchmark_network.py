"""The small network of the benchmark of RCV Fig. 10: deterministic, of the perceptual loss's shape, and better than chance."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.rcv.fig10_perceptual import train
from unrender import losses

PICTURES = functools.cache(train.pictures)
"""Decoded once for all tests."""


@pytest.fixture(autouse=True)
def torch() -> Any:
    """Import the extra for these tests, not at collection: every test process would take seconds for it."""
    return pytest.importorskip("torch")


@pytest.fixture(autouse=True)
def pictures_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "pictures", PICTURES)


@pytest.mark.slow
def test_the_same_weights_at_every_call_that_the_loss_takes(tmp_path: Path, torch: Any) -> None:
    files = [tmp_path / f"{number}.pth" for number in range(3)]
    for file, seed in zip(files, (0, 0, 1), strict=True):
        train.train(file, steps=2, batch=4, side=8, seed=seed)
    first, again, other = (torch.load(file, weights_only=True) for file in files)
    assert all(bool((first[name] == again[name]).all()) for name in first)
    assert not bool((first["features.0.weight"] == other["features.0.weight"]).all())
    loss = losses.Perceptual(files[0], train.LAYERS)
    image = np.random.default_rng(0).uniform(0, 1, (8, 8, 3))
    assert float(loss.value(image, image).mean()) == 0.0
    assert float(loss.value(0.5 * image, image).mean()) > 0.0


@pytest.mark.slow
def test_it_learns(tmp_path: Path) -> None:
    found = train.train(tmp_path / "w.pth", steps=40, batch=16, side=16)
    assert found["accuracy"] > 3 * found["chance"]
    assert np.mean(found["losses"][-5:]) < np.mean(found["losses"][:5])


def test_crops_are_of_their_pictures_and_the_wall_is_none_of_them() -> None:
    given = train.pictures()
    assert len(given) == len(train.PICTURES)
    assert "astronaut" not in train.PICTURES
    assert all(picture.ndim == 3 and picture.min() >= 0 and picture.max() <= 1 for picture in given)
    marked = [np.full((12, 12, 3), label / 10, np.float32) for label in range(5)]
    batch, labels = train.crops(marked, 20, 8, np.random.default_rng(0))
    assert batch.shape == (20, 3, 8, 8)
    restored = np.moveaxis(batch, 1, -1) * train.DEVIATION + train.MEAN
    np.testing.assert_allclose(restored, np.broadcast_to(labels[:, None, None, None] / 10, restored.shape), atol=1e-5)
