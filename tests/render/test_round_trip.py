"""A recovered asset, exported and read back by other libraries, shows held-out photographs as well as the run does."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur

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


def test_exports_lose_less_than_a_decibel(recovered: Any, tmp_path: Path) -> None:
    from benchmarks.round_trip.run import compare

    problem, held_out, values = recovered
    found = compare(problem, held_out, values, tmp_path / "asset", SPP)
    own = np.array(found["run"]["photographs"])
    for kind, row in found.items():
        print(kind, row)
        assert (own - row["photographs"] < LOSS).all()
        assert np.mean(row["pictures"]) > np.mean(found["run"]["pictures"]) - NOISE


def test_a_planted_fault_loses_more(recovered: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Base colours that are read as if they were linear."""
    from benchmarks.round_trip import readers, run

    def wrong(folder: Path) -> list[readers.Look]:
        return [
            dataclasses.replace(look, base_colour=look.base_colour ** (1 / 2.2)) for look in readers.read_glb(folder)
        ]

    monkeypatch.setitem(readers.READERS, "glb", wrong)
    problem, held_out, values = recovered
    found = run.compare(problem, held_out, values, tmp_path / "asset", SPP)
    own = np.array(found["run"]["photographs"])
    assert (own - found["glb"]["photographs"] > LOSS).any()
    assert np.mean(found["glb"]["pictures"]) < np.mean(found["run"]["pictures"]) - NOISE
