"""A recovered asset, exported and read back by other libraries, shows held-out photographs as well as the run does."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import unrender as ur
from tests import asset_readers
from unrender.app.evaluation.measures import measure

pytest.importorskip("trimesh")
pytest.importorskip("pygltflib")
pytestmark = pytest.mark.slow
UNKNOWNS = ("colour", "roughness", "metallic", "normal", "light")
SPP = 128
LOSS = 1.0
NOISE = 2.0
"""dB. Of two pictures against one another: that of the run's own at other random numbers is known to about 1 dB."""


@pytest.fixture(scope="module")
def recovered(tmp_path_factory: pytest.TempPathFactory) -> tuple[ur.Problem, ur.Problem, dict[str, np.ndarray]]:
    folder = tmp_path_factory.mktemp("round-trip")
    ur.gallery.photographs(folder / "photographs", views=9, size=32, spp=64)
    options = ur.app.ImportOptions(resolution=32, texture=32, faces=800, voxels=32, unknowns=UNKNOWNS)
    ur.app.import_capture(folder / "photographs", folder / "problem", options)
    problem = ur.Problem.from_file(folder / "problem" / "problem.toml")
    result = ur.optimize(problem, "auto", steps=20)
    assert np.ptp(result.parameters["asset.bsdf.normalmap.data"]) > 0.1
    return problem, ur.Problem.from_file(folder / "problem" / "held-out.toml"), result.parameters


def cameras(problem: ur.Problem) -> tuple[list[Any], np.ndarray]:
    """The held-out views' sensors, and the rotation of the light's picture before each, (V, 3, 3)."""
    renderer: Any = problem.renderer
    scene = renderer.pair.current
    sensors = [scene.sensors()[view.sensor] for view in problem.views]
    described: Any = mi.traverse(mi.load_file(str(problem.origin["scene"])))  # pyright: ignore
    base = np.array(described["light.to_world"].matrix, float).reshape(4, 4)[:3, :3]
    known = [(view.known or {}).get("light.rotation", [0.0, 0.0, 0.0]) for view in problem.original_views]
    return sensors, Rotation.from_rotvec(known).as_matrix() @ base


def pictures(kind: str, folder: Path, held_out: ur.Problem, spp: int) -> list[np.ndarray]:
    """Of what a format's reader finds in an export, for all held-out views; of "mitsuba", of the scene as it is."""
    sensors, turns = cameras(held_out)
    path: Any = mi.load_dict({"type": "path", "max_depth": held_out.max_depth})
    looks = None if kind == "mitsuba" else asset_readers.READERS[kind](folder)
    scene: Any = mi.load_file(str(folder / "scene.xml")) if looks is None else None
    found = []
    for index, (sensor, turn) in enumerate(zip(sensors, turns, strict=True)):
        if looks is not None and (index == 0 or not np.array_equal(turn, turns[index - 1])):
            scene = mi.load_dict(asset_readers.described(looks, folder / "environment.exr", turn))
        elif looks is None:
            parameters: Any = mi.traverse(scene)
            parameters["light.to_world"] = mi.Transform4f(np.pad(turn, (0, 1)) + np.diag([0.0, 0.0, 0.0, 1.0]))
            parameters.update()
        image = mi.render(scene, sensor=sensor, integrator=path, spp=spp, seed=mi.UInt32(1))  # pyright: ignore
        found.append(np.array(image)[..., :3])
    return found


def compare(problem: ur.Problem, held_out: ur.Problem, values: dict[str, np.ndarray], folder: Path, spp: int) -> dict:
    """{format: PSNR of each held-out photograph, and of the run's own pictures}."""
    formats = ["mitsuba", "environment", *asset_readers.READERS]
    ur.app.export((problem, values), folder, formats=formats)
    known = held_out.renderer.parameters()
    shown = {key: value for key, value in values.items() if key in known}
    judged = ur.Problem(
        held_out.origin["scene"],
        [ur.Parameter(key) for key in shown],
        held_out.original_views,
        max_depth=held_out.max_depth,
    )
    own, other = (
        [np.asarray(ur.render(judged, shown, view=view, spp=spp, seed=seed)) for view in range(len(judged.views))]
        for seed in (0, 1)
    )
    photographs = [(np.asarray(view.reference), np.asarray(view.mask)) for view in judged.views]

    def psnr(images: list[np.ndarray], against: list[np.ndarray]) -> list[float]:
        triples = zip(images, against, photographs, strict=True)
        return [measure(image, wanted, mask).psnr for image, wanted, (_, mask) in triples]

    references = [reference for reference, _ in photographs]
    found = {"run": {"photographs": psnr(own, references), "pictures": psnr(other, own)}}
    for kind in ("mitsuba", *asset_readers.READERS):
        images = pictures(kind, folder, judged, spp)
        found[kind] = {"photographs": psnr(images, references), "pictures": psnr(images, own)}
    return found


def test_exports_lose_less_than_a_decibel(recovered: Any, tmp_path: Path) -> None:
    problem, held_out, values = recovered
    found = compare(problem, held_out, values, tmp_path / "asset", SPP)
    own = np.array(found["run"]["photographs"])
    for kind, row in found.items():
        print(kind, row)
        assert (own - row["photographs"] < LOSS).all()
        assert np.mean(row["pictures"]) > np.mean(found["run"]["pictures"]) - NOISE


def test_a_planted_fault_loses_more(recovered: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Base colours that are read as if they were linear."""

    def wrong(folder: Path) -> list[asset_readers.Look]:
        return [
            dataclasses.replace(look, base_colour=look.base_colour ** (1 / 2.2))
            for look in asset_readers.read_glb(folder)
        ]

    monkeypatch.setitem(asset_readers.READERS, "glb", wrong)
    problem, held_out, values = recovered
    found = compare(problem, held_out, values, tmp_path / "asset", SPP)
    own = np.array(found["run"]["photographs"])
    assert (own - found["glb"]["photographs"] > LOSS).any()
    assert np.mean(found["glb"]["pictures"]) < np.mean(found["run"]["pictures"]) - NOISE
