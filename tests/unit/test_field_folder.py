"""Radiance fields of photographs: the cube that cameras look at, and the stages of its grids."""

from __future__ import annotations

import numpy as np
import pytest

import unrender as ur
from unrender.app.capture import field_folder, importing


def around(middle: np.ndarray, distance: float, count: int = 6) -> np.ndarray:
    """Cameras on a circle about a point, which they look at, (V, 4, 4), axes right, up, backwards."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle in zip(poses, np.linspace(0, 4, count), strict=True):
        backwards = np.array([np.cos(angle), 0.3, np.sin(angle)]) / np.hypot(1, 0.3)
        right = np.cross([0, 1, 0], backwards)
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(backwards, right), backwards], 1)
        pose[:3, 3] = middle + distance * backwards
    return poses


def test_the_cube_is_about_what_the_cameras_look_at() -> None:
    middle = np.array([1.0, -2.0, 0.5])
    found, half = field_folder.cube_of(around(middle, 3.0))
    np.testing.assert_allclose(found, middle, atol=1e-9)
    assert half == pytest.approx(3.0)
    flipped = around(middle, 3.0)
    flipped[:, :3, 1:3] *= -1
    with pytest.raises(ur.InputError, match="look away"):
        field_folder.cube_of(flipped)
    parallel = np.tile(np.eye(4), (3, 1, 1))
    parallel[:, 0, 3] = [0, 1, 2]
    with pytest.raises(ur.InputError, match="in parallel"):
        field_folder.cube_of(parallel)


@pytest.mark.parametrize(("voxels", "names"), [(128, [16, 32, 64, 128]), (48, [12, 24, 48]), (10, [10])])
def test_stages_double_the_voxels(voxels: int, names: list[int]) -> None:
    stages = field_folder._stages(voxels, ["extinction", "emission"])
    assert [stage.name for stage in stages.stages] == [f"voxels-{n}" for n in names]
    assert [voxels // stage.coarser for stage in stages.stages] == names
    assert stages.stages[0].unknowns == ("field.sigma_t.data", "field.emission.data")
    shares = [stage.share for stage in stages.stages]
    assert all(share == max(1.0, sum(shares[:index])) for index, share in enumerate(shares))
    pixels = [int(stages.settings_of(stage)["pixels"]) for stage in stages.stages]
    assert pixels == [max(4096, 128 * side) for side in names]


def test_a_field_has_no_mesh_and_unknowns_of_its_own(tmp_path) -> None:
    with pytest.raises(ur.InputError, match="no --mesh"):
        ur.app.ImportOptions(field=16, mesh=tmp_path / "a.ply")
    with pytest.raises(ur.InputError, match="expected light, exposure or both for a radiance field"):
        ur.app.import_capture(tmp_path, tmp_path / "out", ur.app.ImportOptions(field=16, unknowns=("colour",)))
    with pytest.raises(ur.InputError, match="--band: does not apply to a radiance field; leave it out"):
        ur.app.import_capture(tmp_path, tmp_path / "out", ur.app.ImportOptions(field=16, band=2))
    with pytest.raises(ur.InputError, match="--field: does not apply to a check of the mesh"):
        importing.check(tmp_path, tmp_path / "out", ur.app.ImportOptions(field=16))
