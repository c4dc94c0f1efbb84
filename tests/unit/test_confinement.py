"""What an input names outside of its folder is refused in every format and by every way out: `..`, absolute names, links."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from unrender.app.capture import formats
from unrender.app.capture.formats import lights
from unrender.core.errors import InputError
from unrender.io import confinement


@pytest.fixture(autouse=True)
def _confined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(confinement.VARIABLE, raising=False)


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """A picture that is not the capture's."""
    Image.new("RGB", (8, 6)).save(tmp_path / "x.png")
    return tmp_path / "x.png"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "deep" / "capture"
    (place / "images").mkdir(parents=True)
    Image.new("RGB", (8, 6)).save(place / "images" / "a.png")
    return place


def _transforms(folder: Path, photograph: str, mask: str | None = None) -> None:
    frame = {"file_path": photograph, "transform_matrix": np.eye(4).tolist()}
    frame |= {} if mask is None else {"mask_path": mask}
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": [frame]}))


def _colmap(folder: Path, photograph: str) -> None:
    (folder / "cameras.txt").write_text("1 PINHOLE 8 6 10 10 4 3\n")
    (folder / "images.txt").write_text(f"1 1 0 0 0 0 0 0 1 {photograph}\n\n")


def _linked(folder: Path, outside: Path) -> str:
    (folder / "images" / "link.png").symlink_to(outside)
    return "images/link.png"


NAMES: dict[str, Callable[[Path, Path], str]] = {
    "above": lambda folder, outside: "../../x.png",
    "above, with backslashes": lambda folder, outside: "..\\..\\x.png",
    "above, without ending": lambda folder, outside: "../../x",
    "absolute": lambda folder, outside: str(outside),
    "a link": _linked,
}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("what", ["photograph", "mask", "photograph of COLMAP"])
def test_files_outside_are_refused(
    what: str, name: str, folder: Path, outside: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = NAMES[name](folder, outside)
    if what != "photograph" and ("backslashes" in name or "without" in name):
        pytest.skip("only transforms.json has such names")
    if what == "photograph":
        _transforms(folder, given)
    elif what == "mask":
        _transforms(folder, "images/a.png", given)
    else:
        _colmap(folder, given.removeprefix("images/") if name != "above" else "../../../x.png")
    with pytest.raises(InputError, match=rf"names the {what.split()[0]} .*lies outside .*--allow-outside") as caught:
        formats.read(folder)
    assert str(caught.value).count("\n") == 0
    monkeypatch.setenv(confinement.VARIABLE, "1")
    assert len(formats.read(folder).photographs) == 1


def test_a_folder_of_photographs_that_is_a_link_is_refused(folder: Path, tmp_path: Path) -> None:
    """LLFF, whose file names no photographs."""
    (folder / "images").rename(tmp_path / "elsewhere")
    (folder / "images").symlink_to(tmp_path / "elsewhere")
    row = np.r_[np.column_stack([np.eye(3), np.zeros(3), [6, 8, 10]]).ravel(), 1, 9]
    np.save(folder / "poses_bounds.npy", np.array([row]))
    with pytest.raises(InputError, match=r"names the photograph .*lies outside"):
        formats.read(folder)


@pytest.mark.parametrize("linked", ["a1.png", "mask.png"])
def test_photographs_under_lights_are_confined(linked: str, folder: Path, outside: Path) -> None:
    rows = [[0.3, 0, 1], [-0.3, 0, 1], [0, 0.3, 1], [0, -0.3, 1]]
    (folder / "lights.txt").write_text("4\n" + "".join(f"{x} {y} {z}\n" for x, y, z in rows))
    for name in ("a1.png", "a2.png", "a3.png", "a4.png", "mask.png"):
        if name == linked:
            (folder / name).symlink_to(outside)
        else:
            Image.new("RGB", (8, 6)).save(folder / name)
    with pytest.raises(InputError, match="lies outside"):
        lights.read(folder)


def test_files_inside_are_read_whatever_the_way(folder: Path, tmp_path: Path) -> None:
    """Links within a folder, a folder that is a link itself, masks in the folder that was given for them."""
    (folder / "images" / "b.png").symlink_to("a.png")
    _transforms(folder, "../capture/images/b.png")
    assert len(formats.read(folder).photographs) == 1
    (tmp_path / "way").symlink_to(folder)
    assert len(formats.read(tmp_path / "way").photographs) == 1
    (tmp_path / "masks").mkdir()
    Image.new("L", (8, 6)).save(tmp_path / "masks" / "b.png")
    found = formats.read(folder, masks=tmp_path / "masks").photographs[0]
    assert found.mask == tmp_path / "masks" / "b.png"


def test_a_neighbour_whose_name_begins_alike_is_outside(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene-2").mkdir()
    (tmp_path / "scene-2" / "a.ply").touch()
    with pytest.raises(InputError, match="lies outside"):
        confinement.check(tmp_path / "scene" / ".." / "scene-2" / "a.ply", [tmp_path / "scene"], "a scene names")
    with confinement.within(tmp_path):
        confinement.check(tmp_path / "scene-2" / "a.ply", [tmp_path / "scene"], "a scene names")
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(InputError):
        confinement.check(tmp_path / "loop", [tmp_path / "scene"], "a scene names")


@pytest.mark.parametrize("write", [_transforms, _colmap])
def test_a_name_that_no_file_can_have_is_that_of_none(write: Callable[[Path, str], None], folder: Path) -> None:
    write(folder, 300 * "x" + ".png")
    with pytest.raises(InputError, match="all of its photographs are missing"):
        formats.read(folder)
