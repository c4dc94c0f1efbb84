"""Reference images that are kept: found again by what decides them, never trusted blindly, and no matter where they cannot be kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from tiers import quick, slow
from unrender.backend import cache
from unrender.gallery import specification
from unrender.gallery.rooms import IndirectRoom
from unrender.rendering.mitsuba.scene_loading import load

SMALL = {"resolution": 8, "texture_resolution": 4, "reference_spp": 4}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(cache.ENVIRONMENT_VARIABLE, str(tmp_path))
    return tmp_path / "references"


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The sensors whose references were rendered, not read."""
    found: list[int] = []
    render = specification._render

    def note(scene: Any, sensor: int, *rest: Any) -> np.ndarray:
        found.append(sensor)
        return render(scene, sensor, *rest)

    monkeypatch.setattr(specification, "_render", note)
    return found


def reference(**options: Any) -> np.ndarray:
    room = IndirectRoom(**(SMALL | options))  # pyright: ignore[reportArgumentType]
    return specification.reference(load(room.scene), 0, room.reference_spp, room.max_depth)


def test_a_reference_is_rendered_once(place: Path, rendered: list[int]) -> None:
    first = reference()
    np.testing.assert_array_equal(reference(), first)
    assert rendered == [0]
    assert [path.suffix for path in place.iterdir()] == [".npz"]


@pytest.mark.slow
def test_each_view_is_rendered_once(place: Path, rendered: list[int]) -> None:
    """Rendering one view changes what the scene says of its sampler, and so does reading it instead of rendering it."""
    options = {"resolution": 8, "reference_spp": 8}
    views = len(ur.gallery.problem("two-planets", **options).views)
    assert views > 1
    for _ in range(2):
        ur.gallery.problem("two-planets", **options)
    assert rendered == list(range(views))
    assert len(list(place.iterdir())) == views


@pytest.mark.slow
def test_a_gallery_problem_takes_it_from_there(place: Path, rendered: list[int]) -> None:
    first = reference()
    found = ur.gallery.problem("indirect-room", loss="L2", **SMALL)  # the loss decides nothing of a reference
    np.testing.assert_array_equal(found.views[0].reference, first)
    assert rendered == [0]
    assert len(list(place.iterdir())) == 1


@pytest.mark.parametrize(
    "options",
    quick([{"resolution": 9}, {"texture_resolution": 5}, {"reference_spp": 5}, {"max_depth": 3}], {"reference_spp": 5}),
)
def test_what_decides_the_reference_makes_another(place: Path, rendered: list[int], options: dict[str, int]) -> None:
    reference()
    reference(**options)
    assert len(rendered) == len(list(place.iterdir())) == 2


@pytest.mark.parametrize("damage", [slow(b"no archive"), b"cut"])
def test_a_damaged_file_is_rendered_anew_and_replaced(place: Path, rendered: list[int], damage: bytes) -> None:
    first = reference()
    (path,) = place.iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] if damage == b"cut" else damage)
    np.testing.assert_array_equal(reference(), first)
    assert len(rendered) == 2
    assert path.read_bytes() == whole


@pytest.mark.slow
def test_an_array_of_another_size_is_not_used(place: Path, rendered: list[int]) -> None:
    first = reference()
    (path,) = place.iterdir()
    np.savez(path, allow_pickle=False, reference=np.zeros((4, 4, 3), np.float32))
    np.testing.assert_array_equal(reference(), first)
    assert len(rendered) == 2


@pytest.mark.slow
def test_nothing_is_kept_where_it_is_bypassed_or_cannot_be(
    place: Path, rendered: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    with cache.bypassed():
        reference()
    assert not place.exists()
    place.parent.joinpath("file").write_text("")
    monkeypatch.setenv(cache.ENVIRONMENT_VARIABLE, str(place.parent / "file"))
    reference()
    assert len(rendered) == 2


def test_references_in_a_folder_that_is_full_are_rendered(
    place: Path, rendered: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise ur.InputError("cannot be written: No space left on device")

    monkeypatch.setattr("unrender.gallery.specification.files.write_arrays", full)
    reference()
    assert rendered == [0]
