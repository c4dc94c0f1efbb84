"""Reconstruction of scenes made by others, through the command line as a user types it.

ASSETS holds `tutorials/` (mitsuba-tutorials' scenes) and `spot/`, `textures/` (Keenan Crane's model, mitsuba-data's
images). `cbox`: the tutorials' cbox.xml with its mirror and glass spheres, a photograph on its back wall. `spot`: Spot
with its own texture under museum.exr, seen from four sides. The references are rendered by Mitsuba's `path`; the
textures start grey. Scenes, references, problem files and run folders are written below out/benchmarks/real_input/.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from skimage.transform import resize

from benchmarks.internals import mi
from benchmarks.runner.catalogue import ROOT
from benchmarks.runner.records import scratch

TEXTURE = 128
METHODS = {"plain": ["spp=8", "learning_rate=0.01"], "rcv": ["spp=2", "learning_rate=0.01"]}
QUICK = {"scene": ("cbox",), "seconds": 0.5, "resolution": 16, "reference_spp": 8}


def photograph(path: Path, size: int = TEXTURE) -> np.ndarray:
    """A photograph as linear float32 (size, size, 3)."""
    bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    small: Any = resize(np.array(bitmap), (size, size, 3), anti_aliasing=True)
    return np.clip(small, 0.02, 0.95).astype(np.float32)


def cornell_box(assets: Path, resolution: int) -> str:
    """The tutorials' cbox.xml, with pixels whose samples are their own."""
    text = (assets / "tutorials/cbox.xml").read_text().replace('"meshes/', f'"{assets / "tutorials/meshes"}/')
    text = text.replace('name="res" value="256"', f'name="res" value="{resolution}"')
    return text.replace('<rfilter type="tent"/>', '<rfilter type="box"/>')


def cbox(assets: Path, folder: Path, resolution: int, texture: int = TEXTURE) -> tuple[str, int]:
    """The Cornell box, its back wall with texture coordinates and a photograph."""
    mi.Bitmap(photograph(assets / "tutorials/textures/flower_photo.jpeg", texture)).write(str(folder / "truth.exr"))
    wall = (assets / "tutorials/meshes/cbox_back.obj").read_text()
    wall = wall.replace("f 1 2 3 4", "vt 1 0\nvt 1 1\nvt 0 1\nvt 0 0\nf 1/1 2/2 3/3 4/4")
    (folder / "back.obj").write_text(wall)
    paper = (
        '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="truth.exr"/>'
        '<boolean name="raw" value="true"/></texture></bsdf>'
    )
    back = f'<shape type="obj" id="back"><string name="filename" value="back.obj"/>{paper}</shape>'
    box = cornell_box(assets, resolution)
    (folder / "scene.xml").write_text(re.sub(r'<shape type="obj" id="back">.*?</shape>', back, box, flags=re.DOTALL))
    return "back.bsdf.reflectance.data", 1


def spot(assets: Path, folder: Path, resolution: int, texture: int = TEXTURE) -> tuple[str, int]:
    """Spot under an environment map, four cameras around it."""
    mi.Bitmap(photograph(assets / "spot/spot_texture.png", texture)).write(str(folder / "truth.exr"))
    cameras = "".join(
        f'<sensor type="perspective"><float name="fov" value="40"/><transform name="to_world">'
        f'<lookat origin="{3 * np.sin(a):.4f}, 0.7, {3 * np.cos(a):.4f}" target="0, 0.1, 0" up="0, 1, 0"/></transform>'
        f'<film type="hdrfilm"><integer name="width" value="{resolution}"/><integer name="height" value="{resolution}"/>'
        f'<rfilter type="box"/></film></sensor>'
        for a in np.radians([30, 120, 210, 300])
    )
    (folder / "scene.xml").write_text(
        f'<scene version="3.0.0">{cameras}<emitter type="envmap"><string name="filename" '
        f'value="{assets / "textures/museum.exr"}"/></emitter><shape type="obj" id="spot"><string name="filename" '
        f'value="{assets / "spot/spot.obj"}"/><bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
        f'<string name="filename" value="truth.exr"/><boolean name="raw" value="true"/></texture></bsdf></shape></scene>'
    )
    return "spot.bsdf.reflectance.data", 4


SCENES = {"cbox": cbox, "spot": spot}


def prepare(make: Any, assets: Path, folder: Path, resolution: int, spp: int) -> None:
    """Write the scene, its references and the problem file."""
    folder.mkdir(parents=True, exist_ok=True)
    key, views = make(assets, folder, resolution)
    scene = mi.load_file(str(folder / "scene.xml"))
    path = mi.load_dict({"type": "path", "max_depth": 6})
    lines = [
        'scene = "scene.xml"',
        'loss = "L1"',
        "max_depth = 6",
        "",
        "[[parameters]]",
        f'key = "{key}"',
        "initial = 0.5",
    ]
    lines += ['truth = "truth.exr"']
    for view in range(views):
        parts = [mi.render(scene, sensor=view, integrator=path, spp=spp // 8, seed=n) for n in range(8)]
        image = np.mean([np.array(part) for part in parts], axis=0)
        mi.Bitmap(image.astype(np.float32)).write(str(folder / f"view{view}.exr"))
        lines += ["", "[[views]]", f'reference = "view{view}.exr"', f"sensor = {view}"]
    (folder / "problem.toml").write_text("\n".join(lines) + "\n")


def recover(folder: Path, method: str, seconds: float, settings: list[str]) -> dict[str, Any]:
    """Run the command line and read what it left."""
    out = folder / method
    command = ["unrender", "run", str(folder / "problem.toml"), "--method", method, "--seconds", str(seconds)]
    command += [word for setting in settings for word in ("--set", setting)] + ["--out", str(out), "--overwrite"]
    print(" ".join(command), flush=True)
    subprocess.run([sys.executable, "-m", *command], check=True)
    run = json.loads((out / "run.json").read_text())
    errors = [json.loads(line) for line in (out / "history.jsonl").read_text().splitlines()]
    errors = [next(iter(e["parameter_error"].values())) for e in errors if e.get("parameter_error")]
    with np.load(out / "pictures.npz") as pictures:
        image = [
            float(np.sqrt(np.mean((pictures[f"view0/{what}"] - pictures["view0/reference"]) ** 2)))
            for what in ("initial", "result")
        ]
    with (
        np.load(out / "parameters.npz") as found,
        np.load(out / "truth.npz") as truth,
        np.load(out / "initial.npz") as start,
    ):
        key = next(iter(found))
        seen = np.abs(found[key] - start[key]).max(axis=-1) > 1e-3  # texels that any view tells of
        rmse = [float(np.sqrt(np.mean((x[key] - truth[key])[seen] ** 2))) for x in (start, found)]
    return {
        "command": " ".join(["unrender", *command[1:]]).replace(f"{ROOT}/", ""),
        "steps": run["steps"],
        "seconds": run["seconds"],
        "texture_rmse": [errors[0], errors[-1]],
        "texture_rmse_where_seen": rmse,
        "share_seen": float(seen.mean()),
        "image_rmse_view0": image,
    }


def images(folder: Path) -> dict[str, np.ndarray]:
    """Of a finished run, for the figure: the first view's reference, start and result; the true and the found texture."""
    with (
        np.load(folder / "pictures.npz") as views,
        np.load(folder / "parameters.npz") as found,
        np.load(folder / "truth.npz") as truth,
    ):
        shown = {name: views[f"view0/{name}"] for name in ("reference", "initial", "result")}
        return shown | {"true texture": next(iter(truth.values())), "texture": next(iter(found.values()))}


def run(
    assets: Path,
    scene: tuple[str, ...] = tuple(SCENES),
    seconds: float = 60.0,
    resolution: int = 128,
    reference_spp: int = 2048,
) -> dict[str, Any]:
    """Every scene by both methods.

    Args:
        assets: folder of the scenes
        seconds: budget of a run
    """
    scenes: dict[str, Any] = {}
    maps: dict[str, np.ndarray] = {}
    for name in scene:
        folder = scratch(f"real_input/{name}")
        prepare(SCENES[name], assets.resolve(), folder, resolution, reference_spp)
        scenes[name] = {by: recover(folder, by, seconds, settings) for by, settings in METHODS.items()}
        maps |= {f"{name}/{what}": image for what, image in images(folder / "rcv").items()}
    return {"scenes": scenes, "maps": maps}
