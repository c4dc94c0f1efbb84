"""The unknowns of an import: bounds, rates, and the stages that move them."""

from __future__ import annotations

from pathlib import Path

import pytest

from unrender.app.capture import unknowns
from unrender.app.stages.stages_file import split
from unrender.core.errors import InputError
from unrender.methods import method


def _stages(*names: str) -> list[tuple[str, list[str], object]]:
    """Name, unknowns by name and settings of each."""
    of = {key: name for name, key in unknowns.keys(names).items()}
    found = unknowns.stages(names, Path("problem.toml")).stages
    return [(stage.name, [of[key] for key in stage.unknowns], stage.settings) for stage in found]


LATE = {"learning_rate": 0.02}
DETAIL = {**LATE, "correlation": 1 / 128}


def test_a_hull_has_its_normals_and_then_all_detail_by_shorter_steps() -> None:
    materials = ["colour", "roughness", "metallic", "light"]
    assert _stages(*unknowns.OF_HULL) == [
        ("coarse-materials", materials, {}),
        ("materials", materials, {}),
        ("normals", list(unknowns.OF_HULL), LATE),
        ("detail", list(unknowns.OF_HULL), DETAIL),
    ]
    stages = unknowns.stages(unknowns.OF_HULL, Path("problem.toml"))
    split_up = split(stages.__class__(stages.problem, stages.stages, seconds=12.0))
    assert [seconds for _, seconds in split_up] == [1, 3, 4, 4]


def test_without_normals_detail_alone_has_settings_of_its_own() -> None:
    assert [settings for *_, settings in _stages(*unknowns.DEFAULT)] == [{}, {}, DETAIL]


def test_a_shape_keeps_the_short_steps_of_the_stages_before_it() -> None:
    assert _stages("shape", *unknowns.OF_HULL)[-1][::2] == ("shape", DETAIL)
    assert [name for name, *_ in _stages("shape")] == ["shape"]
    assert [name for name, *_ in _stages("exposure")] == ["photographs"]


def test_settings_of_stages_are_options_of_the_method() -> None:
    stages = unknowns.stages(unknowns.OF_HULL, Path("problem.toml"))
    for stage in stages.stages:
        method(stage.method or stages.method).start(stages.settings_of(stage))


def test_normals_have_a_rate_of_their_own_and_smoothest_materials_are_out_of_reach_beside_them() -> None:
    of = {table["key"]: table for table in unknowns.parameters(unknowns.OF_HULL, 1.0)}
    # The settings of the last stage leave it as it is.
    assert of["asset.bsdf.normalmap.data"]["learning_rate"] == 0.01
    assert of["asset.bsdf.nested_bsdf.roughness.data"]["bounds"] == [0.25, 1.0]
    flat = {table["key"]: table for table in unknowns.parameters(unknowns.DEFAULT, 1.0)}
    assert flat["asset.bsdf.roughness.data"]["bounds"] == [0.02, 1.0]
    assert not any("learning_rate" in table for table in flat.values())


@pytest.mark.parametrize("text", ["", "color", "colour,lihgt"])
def test_what_is_no_unknown_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--unknowns: "):
        unknowns.parse(text)
