"""Textures and values at vertices of one surface whose changes hide one another are named, and determined ones are not."""

from __future__ import annotations

import io
import math
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.app.cli.execute import summarise
from unrender.core.text import listed
from unrender.display.terminal import Console
from unrender.runs import joint_maps
from unrender.runs.joint_maps import hidden_changes, untested_changes
from unrender.runs.progress import Progress

SIZE, TEXELS = 16, 8
NORMALS, COLOUR = "wall.bsdf.normalmap.data", "wall.bsdf.nested_bsdf.reflectance.data"
BUMPS = "wall.bsdf.nested_texture.data"
LAMPS = ([1.5, 1.0, 2.0], [-1.5, 1.0, 2.0], [0.0, -1.5, 2.0])


def scene(*colours: Any) -> dict[str, Any]:
    """A diffuse wall with bumps and a picture, before lamps of these colours."""
    rng = np.random.default_rng(1)
    normals = np.concatenate(
        [0.5 + rng.uniform(-0.15, 0.15, (TEXELS, TEXELS, 2)), np.ones((TEXELS, TEXELS, 1))], axis=-1
    )
    picture = rng.uniform(0.2, 0.8, (TEXELS, TEXELS, 3))
    maps = [{"type": "bitmap", "bitmap": mi.Bitmap(x.astype(np.float32)), "raw": True} for x in (normals, picture)]
    look = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    lamps = {
        f"lamp{n}": {"type": "point", "position": place, "intensity": {"type": "rgb", "value": colour}}
        for n, (place, colour) in enumerate(zip(LAMPS, colours, strict=False))
    }
    material = {"type": "normalmap", "normalmap": maps[0], "bsdf": {"type": "diffuse", "reflectance": maps[1]}}
    return {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 36, "to_world": look, "film": film},
        "wall": {"type": "rectangle", "bsdf": material},
        **lamps,
    }


def problem(keys: tuple[str, ...], colours: list[Any], lit_apart: bool) -> ur.Problem:
    """The wall in one picture, or in one of each lamp."""
    reference = np.full((SIZE, SIZE, 3), 0.3, np.float32)
    names = [f"lamp{n}.intensity.value" for n in range(len(colours))]
    views = [ur.View(reference)]
    if lit_apart:
        views = [ur.View(reference, known={k: [9.0 * (k == name)] * 3 for k in names}) for name in names]
    return ur.Problem(scene(*colours), [ur.Parameter(key) for key in keys], views, max_depth=2)


WHITE, COLOURED = [[6.0] * 3] * 3, [[9.0, 0.5, 0.5], [0.5, 9.0, 0.5], [0.5, 0.5, 9.0]]


@pytest.mark.parametrize(
    ("keys", "colours", "lit_apart", "words"),
    [
        ((NORMALS, COLOUR), WHITE[:1], False, [f"{COLOUR}, {NORMALS}: changes of one hide those of another"]),
        ((NORMALS, COLOUR), WHITE, True, []),
        ((NORMALS,), WHITE[:1], False, [f"{NORMALS}: some turns of its normals change the pictures by"]),
        ((NORMALS,), COLOURED, False, []),
        ((COLOUR,), WHITE, False, []),
    ],
)
def test_changes_that_hide_one_another_are_told(keys: Any, colours: Any, lit_apart: bool, words: list[str]):
    """Three colours of a pixel determine a normal or a colour, not both; three pictures under one lamp each do."""
    made = problem(keys, colours, lit_apart)
    lines = hidden_changes(made, made.initial_values(), 16, math.inf)
    assert [line[: len(start)] for line, start in zip(lines, words, strict=True)] == words


def test_textures_of_shapes_whose_ids_have_dots_are_of_one_surface_each(tmp_path: Path):
    """Blender names shapes Wall.001 and Wall.002; colours of the two hid one another in a scene without a fault."""
    made = mi.Bitmap(np.full((4, 4, 3), [0.5, 0.5, 1.0], np.float32))
    made.write(str(tmp_path / "map.exr"))
    texture = '<texture name="{}" type="bitmap"><string name="filename" value="map.exr"/><boolean name="raw" value="true"/></texture>'
    diffuse = f'<bsdf type="diffuse">{texture.format("reflectance")}</bsdf>'
    bumps = f'<bsdf type="normalmap">{texture.format("normalmap")}{diffuse}</bsdf>'
    shapes = "".join(
        f'<shape type="sphere" id="Wall.00{n}"><bsdf type="twosided">{bsdf}</bsdf></shape>'
        for n, bsdf in enumerate((diffuse, diffuse, bumps))
    )
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/>'
        f'<integer name="height" value="8"/></film></sensor>{shapes}<emitter type="constant"/></scene>'
    )
    keys = [f"Wall.00{n}.bsdf.brdf_0.reflectance.data" for n in range(2)]
    both = [f"Wall.002.bsdf.brdf_0.{name}.data" for name in ("nested_bsdf.reflectance", "normalmap")]
    found = ur.Problem(
        tmp_path / "scene.xml", [ur.Parameter(key) for key in keys + both], [ur.View(np.zeros((8, 8, 3)))]
    )
    (line,) = untested_changes(found)
    assert line.startswith(f"whether changes of {listed(both)} hide")


@pytest.mark.parametrize("beside", [(), ("normalmap",), ("bumpmap",)])
def test_a_standard_error_holds_if_other_textures_of_the_surface_are_right(beside: tuple[str, ...]):
    """A colour beside a bump map was .042 from the truth; its standard error was .006, "right to a factor of 1.7"."""
    described, text = scene(*WHITE[:1]), io.StringIO()
    if bumps := "bumpmap" in beside:
        heights = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((TEXELS, TEXELS, 1), 0.5, np.float32)), "raw": True}
        described["wall"]["bsdf"] = {**described["wall"]["bsdf"], "type": "bumpmap", "arbitrary": heights}
        described["wall"]["bsdf"].pop("normalmap")
    keys = [*([BUMPS if bumps else NORMALS] * bool(beside)), COLOUR]
    view = ur.View(np.full((SIZE, SIZE, 3), 0.3, np.float32))
    made = ur.Problem(described, [ur.Parameter(key) for key in keys], [view], max_depth=2)
    values = made.initial_values()
    error, share = ({COLOUR: np.full_like(values[COLOUR], x)} for x in (0.01, 1.0))
    result = ur.Result(values, values, [], 1.0, 0.0, "steps", standard_error=error, data_share=share)
    with Progress(Console(file=text, width=200)) as progress:
        summarise(Console(file=text, width=200), made, result, progress)
    said = " ".join(text.getvalue().split())
    assert "0.01 (median standard error, right to a factor of 1.7" in said
    assert ("1.7 if the other textures of its surface are right, where" in said) is bool(beside)


def test_a_run_that_is_too_short_for_the_test_says_so():
    made = problem((NORMALS, COLOUR), WHITE[:1], False)
    assert [line.partition(":")[0] for line in hidden_changes(made, made.initial_values(), 16, 0.0)] == [
        f"whether changes of {COLOUR}, {NORMALS} hide one another"
    ]


BOARD = [f"wall.bsdf.{name}.data" for name in ("base_color", "metallic", "roughness")]


def board(**others: float) -> ur.Problem:
    """A wall of equal texels before three lamps, each in a picture of its own. All its maps are unknown."""
    values = {"base_color": [0.5, 0.5, 0.5]} | {name: [value] for name, value in others.items()}
    maps = {name: np.tile(np.array(x, np.float32), (TEXELS, TEXELS, 1)) for name, x in values.items()}
    bsdf = {name: {"type": "bitmap", "bitmap": mi.Bitmap(x), "raw": True} for name, x in maps.items()}
    names = [f"lamp{n}.intensity.value" for n in range(3)]
    reference = np.full((SIZE, SIZE, 3), 0.3, np.float32)
    views = [ur.View(reference, known={k: [9.0 * (k == name)] * 3 for k in names}) for name in names]
    described = {**scene(*WHITE), "wall": {"type": "rectangle", "bsdf": {"type": "principled", **bsdf}}}
    return ur.Problem(described, [ur.Parameter(f"wall.bsdf.{name}.data") for name in values], views, max_depth=2)


@pytest.mark.parametrize("metallic", [0.0, 0.1])
def test_values_at_a_bound_change_inwards(metallic: float):
    """The sign of an eigenvector is arbitrary: at a metallic map of 0 the change left the bounds, and roughness alone changed."""
    made = board(metallic=metallic, roughness=0.5)
    (line,) = hidden_changes(made, made.initial_values(), 16, math.inf)
    assert line.startswith(f"{BOARD[1]}, {BOARD[2]}: changes of one hide those of another")


def test_a_texture_of_small_changes_is_not_named():
    """Changes of a high roughness are hidden by changes of the colour that are a twelfth as large, and both were named."""
    made = board(roughness=0.8)
    (line,) = hidden_changes(made, made.initial_values(), 16, math.inf)
    assert line.startswith(f"{BOARD[2]}: small changes of the surface's other textures hide its changes")
    assert BOARD[0] not in line


def sheet(path: Path, attributes: tuple[str, ...], prior: Any = None) -> ur.Problem:
    """A wall of metal as a mesh, before one lamp, with a colour and a roughness, some of which are at its vertices."""
    starts = {"base_color": [0.5] * 3, "roughness": [0.5]}
    y, x = np.mgrid[: TEXELS + 1, : TEXELS + 1] / TEXELS
    corners = (np.arange(TEXELS)[:, None] * (TEXELS + 1) + np.arange(TEXELS)).reshape(-1, 1)
    faces = np.concatenate([corners + [0, 1, TEXELS + 2], corners + [0, TEXELS + 2, TEXELS + 1]])
    mesh: Any = mi.Mesh("wall", x.size, len(faces), has_vertex_texcoords=True)
    values: Any = mi.traverse(mesh)
    values["vertex_positions"] = mi.Float(np.float32(np.stack([2 * x - 1, 2 * y - 1, 0 * x], axis=-1).ravel()))
    values["vertex_texcoords"] = mi.Float(np.float32(np.stack([x, y], axis=-1).ravel()))
    values["faces"] = mi.UInt32(np.uint32(faces.ravel()))
    values.update()
    bsdf: dict[str, Any] = {"type": "principled", "metallic": 1.0}
    for name, value in starts.items():
        texels = mi.Bitmap(np.tile(np.array(value, np.float32), (TEXELS, TEXELS, 1)))
        bsdf[name] = {"type": "bitmap", "bitmap": texels, "raw": True}
        if name in attributes:
            mesh.add_attribute(f"vertex_{name}", len(value), np.tile(np.array(value, np.float32), x.size))
            bsdf[name] = {"type": "mesh_attribute", "name": f"vertex_{name}"}
    mesh.write_ply(str(path / "wall.ply"))
    wall = {"type": "ply", "filename": str(path / "wall.ply"), "bsdf": bsdf}
    keys = [f"wall.vertex_{name}" if name in attributes else f"wall.bsdf.{name}.data" for name in starts]
    unknowns = [ur.Parameter(key, prior=prior) for key in keys]
    view = ur.View(np.full((SIZE, SIZE, 3), 0.3, np.float32))
    return ur.Problem({**scene(*WHITE[:1]), "wall": wall}, unknowns, [view], max_depth=2)


@pytest.mark.parametrize("attributes", [("base_color", "roughness"), ("roughness",)])
def test_values_at_vertices_that_hide_others_are_told(attributes: Any, tmp_path: Path):
    """Values at vertices of a mesh that hide others, or a texture, were another solution in silence."""
    found = sheet(tmp_path, attributes)
    (line,) = hidden_changes(found, found.initial_values(), 16, math.inf)
    assert line.startswith(f"{', '.join(sorted(found.unknowns))}: changes of one hide those of another")
    assert not untested_changes(sheet(tmp_path, attributes, prior={"total_variation": 0.1}))


@pytest.mark.parametrize(("priors", "told"), [(0, True), (1, True), (2, False)])
def test_noise_of_few_samples_and_a_prior_of_one_texture_hide_no_other_solution(priors: int, told: bool):
    """A colour and a metallic map ended .07 and .25 from the truth in silence: few samples did not tell, or the colour had a prior."""
    bsdf: dict[str, Any] = {"type": "principled", "roughness": 0.4}
    for name, value in (("base_color", [0.5, 0.5, 0.5]), ("metallic", [0.4])):
        texels = np.tile(np.array(value, np.float32), (TEXELS, TEXELS, 1))
        bsdf[name] = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    radiance = {"type": "rgb", "value": [8.0, 8.0, 8.0]}
    lamp = {"type": "sphere", "center": [1.5, 1, 2], "radius": 0.6, "emitter": {"type": "area", "radiance": radiance}}
    described = {**scene(), "wall": {"type": "rectangle", "bsdf": bsdf}, "sky": {"type": "constant"}, "lamp": lamp}
    prior = {"total_variation": 0.1}
    unknowns = [ur.Parameter(key, prior=prior if n < priors else None) for n, key in enumerate(BOARD[:2])]
    made = ur.Problem(described, unknowns, [ur.View(np.full((SIZE, SIZE, 3), 0.3, np.float32))], max_depth=2)
    lines = hidden_changes(made, made.initial_values(), 1, math.inf)
    assert [line.partition(":")[0] for line in lines] == [f"{BOARD[0]}, {BOARD[1]}"] * told


def test_surfaces_share_the_time(monkeypatch: pytest.MonkeyPatch):
    """Each of them had all of it, so that the end of a run with several took several times its limit."""
    given: list[float] = []

    def line(self: Any, seconds: float) -> list[str]:
        given.append(seconds)
        time.sleep(0.1)
        return []

    monkeypatch.setattr(joint_maps, "_surfaces", lambda problem: [["a", "b"]] * 6)
    monkeypatch.setattr(joint_maps._Surface, "line", line)
    hidden_changes(problem((COLOUR,), WHITE, False), {}, 16, 0.1)
    assert 0.0 < given[0] <= 0.1
    assert max(given[1:]) < 0.0


@pytest.mark.slow
def test_the_end_of_a_run_names_them(tmp_path: Path):
    keys = (NORMALS, COLOUR)
    seen = ur.render(problem(keys, WHITE[:1], False), spp=64, seed=5)
    unknowns = [ur.Parameter(key, initial=start) for key, start in zip(keys, ([0.5, 0.5, 1.0], 0.5), strict=True)]
    made = ur.Problem(scene(*WHITE[:1]), unknowns, [ur.View(seen)], max_depth=2)
    result = ur.optimize(made, steps=16, run_directory=tmp_path / "run")
    assert result.undetermined[-1].startswith(f"{COLOUR}, {NORMALS}: changes of one hide those of another")
