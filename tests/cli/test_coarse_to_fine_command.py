"""Textures that are coarse at first, from the command line: run, resume, report, export."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

KEY = "wall.bsdf.reflectance.data"


@pytest.mark.slow
def test_runs_are_resumed_across_a_change_and_shown(unrender, problem: Path, mitsuba_variant: str):
    folder = problem.parent
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="wall.exr"/></texture>'
    scene = (folder / "wall.xml").read_text()
    (folder / "wall.xml").write_text(scene.replace('<rgb name="reflectance" value="0.2"/>', texture))
    mi.Bitmap(np.full((8, 8, 3), 0.5, np.float32)).write(str(folder / "wall.exr"))
    text = problem.read_text().replace("wall.bsdf.reflectance.value", KEY)
    problem.write_text(text.replace("truth", "coarse_to_fine = [2, 4]\ntruth"))

    run = ["run", "problem.toml", "--out", "result", "--variant", mitsuba_variant, "--final-spp", 4]
    early = unrender(*run, "--steps", 3)
    assert early.status == 0, early.error
    assert f"parameter {KEY}: still 4x4 at the end, after 3 steps of at least 5" in " ".join(early.out.split())
    more = unrender("resume", "result", "--steps", 6)
    assert more.status == 0, more.error
    assert "still" not in more.out
    history = [json.loads(line) for line in (folder / "result" / "history.jsonl").read_text().splitlines()]
    told = {record["step"]: record["resolution"][KEY] for record in history if "resolution" in record}
    assert told == {0: [2, 2], 2: [4, 4], 4: [8, 8]}
    with np.load(folder / "result" / "parameters.npz") as found:
        assert found[KEY].shape == (8, 8, 3)
    assert unrender("report", "result").status == 0
    assert unrender("export", "result", "--out", "scene").status == 0

    problem.write_text(problem.read_text().replace("[2, 4]", "[2, 9, 4]"))
    refused = unrender(*run, "--steps", 3, "--overwrite")
    assert refused.status == 2
    assert "problem.toml:6: parameters[0].coarse_to_fine: steps must be" in refused.error
