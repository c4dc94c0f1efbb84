"""Pictures that wait in a file: exact, in few bytes, pixel by pixel; and problems that keep theirs there."""

from __future__ import annotations

import numpy as np
import pytest

import unrender as ur
from tests.analytic import AnalyticRenderer
from unrender.io import stored_pictures
from unrender.io.stored_pictures import PictureStore, StoredPicture
from unrender.scene import view_checks


def pictures() -> dict[str, tuple[np.ndarray, int]]:
    """Pictures, and the bytes a value that they should take."""
    rng = np.random.default_rng(0)
    return {
        "half": (rng.uniform(0, 3, (5, 7, 3)).astype(np.float16).astype(np.float32), 2),
        "float": (rng.uniform(0, 3, (5, 7, 3)).astype(np.float32), 4),
        "mask": ((rng.integers(0, 256, (5, 7)) / 255).astype(np.float32), 1),
        "soft": (rng.uniform(0, 1, (90, 7)).astype(np.float32), 4),
        "bright": (np.full((2, 2, 3), 1e6, np.float32), 4),
    }


def test_pictures_come_back_exactly_whole_and_by_pixels() -> None:
    store = PictureStore()
    kept = {name: store.add(values) for name, (values, _) in pictures().items()}
    for name, (values, size) in pictures().items():
        found = kept[name]
        np.testing.assert_array_equal(np.asarray(found), values)
        assert (found.shape, found.size, found.nbytes, found.dtype) == (
            values.shape,
            values.size,
            values.nbytes,
            values.dtype,
        )
        assert found._stored_type.itemsize == size, name
        pixels = np.array([3, 0, 3, values.shape[0] * values.shape[1] - 1])
        np.testing.assert_array_equal(found.rows(pixels), values.reshape(values.shape[0] * values.shape[1], -1)[pixels])


def test_a_full_disk_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        def seek(self, place: int) -> None: ...

        def write(self, data: object) -> None:
            raise OSError(28, "No space left on device")

        def close(self) -> None: ...

    monkeypatch.setattr(stored_pictures.tempfile, "TemporaryFile", lambda prefix: Full())
    with pytest.raises(ur.InputError, match="No space left on device; set TMPDIR to another folder"):
        PictureStore().add(np.zeros((2, 2, 3)))


def test_a_problem_whose_pictures_wait_in_a_file_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    renderer = AnalyticRenderer({"map": rng.uniform(0.3, 0.9, 4)}, rng.uniform(0, 1, (48, 4)), sensors=2)
    views = [
        ur.View(rng.uniform(0, 1, (4, 4, 3)), 0),
        ur.View(rng.uniform(0, 1, (4, 4, 3)), 1, mask=rng.uniform(0, 1, (4, 4))),
    ]
    results = []
    for most in (1 << 29, 10):
        monkeypatch.setattr(view_checks, "ON_DEVICE", most)
        problem = ur.Problem(renderer, [ur.Parameter("map", 0.5)], views, max_depth=1)
        assert isinstance(problem.views[0].reference, StoredPicture) == (most == 10)
        monkeypatch.setattr(problem.references, "in_host_memory", most == 10)
        for pixels in (ur.pixels.All(), ur.pixels.Uniform(8)):
            found = ur.optimize(problem, ur.PathGradient(pixels=pixels, spp=4), ur.optimizers.Adam(0.01), steps=3)
            results.append(found.parameters["map"])
        assert bool(problem._references) == (most != 10)
        again = ur.Problem(renderer, [ur.Parameter("map", 0.5)], problem.views, max_depth=1)
        np.testing.assert_array_equal(np.asarray(again.views[1].mask), np.asarray(views[1].mask, np.float32))
    np.testing.assert_allclose(results[0], results[2], rtol=1e-6)
    np.testing.assert_allclose(results[1], results[3], rtol=1e-6)
