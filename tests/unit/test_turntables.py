"""Captures on a turntable, and of one camera under known lights: in NumPy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from unrender.app.capture import photometric_folder, silhouettes
from unrender.app.capture.cameras import Lens
from unrender.app.capture.capture import CapturedView, StoredViews
from unrender.app.capture.formats import is_lit, lights
from unrender.core.errors import InputError

SIZE, COUNT = 48, 12
LENS = Lens(SIZE, SIZE, 60.0, 60.0, SIZE / 2, SIZE / 2)
TILT = 0.4


def _poses(count: int = COUNT) -> np.ndarray:
    """Cameras at one height around a tilted axis, which look at the origin."""
    found = []
    for angle in 2 * np.pi * np.arange(count) / count:
        back = np.array([np.cos(TILT) * np.sin(angle), np.sin(TILT), np.cos(TILT) * np.cos(angle)])
        right = np.array([np.cos(angle), 0, -np.sin(angle)])
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, 5 * back], 1)
        found.append(_WORLD @ pose)
    return np.array(found)


_WORLD = np.eye(4)
_WORLD[:3, :3] = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])


def _views(still: bool) -> list[CapturedView]:
    """Photographs before one background, or before what lies behind the object from each side."""
    rng = np.random.default_rng(0)
    room = np.repeat(np.repeat(rng.uniform(0, 1, (8, 8 * COUNT, 3)), 6, 0), 6, 1).astype(np.float32)
    mask = np.zeros((SIZE, SIZE), np.float32)
    mask[16:32, 16:32] = 1
    found = []
    for index, pose in enumerate(_poses()):
        first = 0 if still else SIZE * index
        values = room[:, first : first + SIZE]
        found.append(CapturedView(str(index), LENS, pose, values, mask, np.ones_like(mask), index % 4 == 0))
    return found


def test_the_axis_and_the_turns_of_a_turntable() -> None:
    poses = _poses()
    np.testing.assert_allclose(silhouettes.axis(poses), _WORLD[:3, 1], atol=1e-12)
    turns = silhouettes.light_turns(poses)
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)
    # As the cameras see it, the light stands still.
    seen = poses[:, :3, :3].transpose(0, 2, 1) @ turns
    np.testing.assert_allclose(seen, np.broadcast_to(seen[0], seen.shape), atol=1e-12)
    np.testing.assert_allclose(seen[0] @ [0, 1, 0], [0, np.cos(TILT), np.sin(TILT)], atol=1e-12)


def test_a_background_that_stands_still_tells_of_a_turntable() -> None:
    assert silhouettes.likeness(_views(still=True)) > 0.99
    assert silhouettes.stands_still(_views(still=True))
    assert abs(silhouettes.likeness(_views(still=False))) < 0.25
    assert not silhouettes.stands_still(_views(still=False))
    assert silhouettes.likeness(_views(still=True)[:3]) == 0


def test_views_are_read_from_their_file_as_they_were() -> None:
    views = _views(still=False)
    stored = StoredViews(views)
    for given, found in zip(views, stored, strict=True):
        assert found.name == given.name
        np.testing.assert_array_equal(found.values, given.values)
        np.testing.assert_array_equal(found.mask, given.mask)  # pyright: ignore[reportArgumentType]
    assert [view.name for view in stored.of(held_out=True)] == ["0", "4", "8"]
    assert len(stored.of(held_out=False)) == 9
    assert all(view.values.size == 0 for view in stored.bare())
    assert StoredViews([]).masked == []


# ---------------------------------------------------------------------- known lights

DIRECTIONS = np.array([[0, 0, 1], [0.5, 0, 1], [-0.5, 0.2, 1], [0, 0.6, 1], [0.3, -0.5, 1], [-0.2, -0.4, 1.0]])


def _folder(folder: Path, directions: np.ndarray = DIRECTIONS, first: str | None = None) -> Path:
    folder.mkdir(exist_ok=True)
    rows = [" ".join(map(str, row)) for row in directions]
    (folder / lights.FILE).write_text("\n".join([str(len(rows)) if first is None else first, *rows]) + "\n")
    for index in range(len(DIRECTIONS)):
        (folder / f"ball.{index + 7}.png").touch()
    (folder / "ball.mask.png").touch()
    return folder


def test_a_folder_with_lights(tmp_path: Path) -> None:
    capture = lights.read(_folder(tmp_path))
    assert [path.name for path in capture.photographs] == [f"ball.{index}.png" for index in range(7, 13)]
    assert capture.mask == tmp_path / "ball.mask.png"
    np.testing.assert_allclose(np.linalg.norm(capture.directions, axis=1), 1)
    assert is_lit(tmp_path, None)
    (tmp_path / "transforms.json").touch()
    assert not is_lit(tmp_path, None)
    assert is_lit(tmp_path, "lights")


@pytest.mark.parametrize(
    ("directions", "first", "expected"),
    [
        (DIRECTIONS, "7", "expected a count"),
        (DIRECTIONS, "many", "expected a count"),
        (DIRECTIONS[:, :2], None, "expected a count"),
        (DIRECTIONS * np.nan, None, "expected a count"),
        (DIRECTIONS[:5], None, "5 lights, and 6 photographs"),
        (DIRECTIONS[:3], None, "at least 4"),
        (DIRECTIONS * [1, 1, -1], None, "behind the object"),
        (DIRECTIONS * [1, 0, 1], None, "in a plane"),
        (DIRECTIONS * [[0], [1], [1], [1], [1], [1]], None, "0 0 0"),
    ],
)
def test_lights_that_cannot_be_used_are_one_line(
    directions: np.ndarray, first: str | None, expected: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=expected) as raised:
        lights.read(_folder(tmp_path, directions, first))
    assert "\n" not in str(raised.value)


def test_least_squares_finds_normals_where_no_shadow_falls() -> None:
    rng = np.random.default_rng(1)
    normals = np.concatenate([rng.uniform(-0.2, 0.2, (5, 4, 2)), np.ones((5, 4, 1))], 2)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    colours = rng.uniform(0.2, 0.9, (5, 4, 3))
    towards = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
    values = np.einsum("kd,ijd->kij", towards, normals)[..., None] * colours
    found, reflectance = photometric_folder.least_squares(values, towards)
    np.testing.assert_allclose(found, normals, atol=1e-9)
    np.testing.assert_allclose(reflectance, colours, atol=1e-9)
    assert photometric_folder.lit(values.mean(-1)).all()
    values[2, 0, 0] = 0
    assert not photometric_folder.lit(values.mean(-1))[0, 0]
