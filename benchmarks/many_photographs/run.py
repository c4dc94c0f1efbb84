"""Memory of a run with many photographs: 20 and 200 of 4 megapixels, mini-batches of pixels from all of them.

A textured wall under an even light, seen by so many cameras; references are 16-bit OpenEXR files, masks 8-bit PNG files, as
`unrender import` writes them (one file stands for all, which is read once for each camera all the same). Each run in a process of its own:
its greatest resident size after reading the problem and some steps into a run folder.
"""

from __future__ import annotations

import resource
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.internals import mi
from benchmarks.runner.timing import in_new_process

KEY = "wall.bsdf.reflectance.data"
QUICK = {"views": (2, 4), "side": 64, "pixels": 256, "steps": 2}
_SENSOR = """<sensor type="perspective" id="camera{i}"><float name="fov" value="40"/><transform name="to_world">
<lookat origin="{x}, 0, 3" target="0, 0, 0" up="0, 1, 0"/></transform><film type="hdrfilm"><integer name="width" value="{side}"/>
<integer name="height" value="{side}"/><rfilter type="box"/></film></sensor>
"""
_WALL = """<shape type="rectangle" id="wall"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
<string name="filename" value="wall.exr"/><string name="format" value="variant"/></texture></bsdf></shape>
<emitter type="constant"><rgb name="radiance" value="1"/></emitter>
"""


def write(folder: Path, views: int, side: int) -> Path:
    """The problem file."""
    y, x = np.mgrid[:side, :side] / side
    picture = 0.5 + 0.3 * np.stack([np.sin(9 * x), np.sin(7 * y), np.sin(5 * (x + y))], -1)
    half = mi.Bitmap(picture.astype(np.float32)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float16, False)
    half.write(str(folder / "photograph.exr"))
    mask = 255 * (np.hypot(x - 0.5, y - 0.5) < 0.45)
    mi.Bitmap(mask[..., None].astype(np.uint8)).write(str(folder / "mask.png"))
    mi.Bitmap(np.full((64, 64, 3), 0.5, np.float32)).write(str(folder / "wall.exr"))
    sensors = "".join(_SENSOR.format(i=i, x=2 * i / views - 1, side=side) for i in range(views))
    (folder / "scene.xml").write_text(f'<scene version="3.0.0">{sensors}{_WALL}</scene>', encoding="utf-8")
    tables = [f'[[parameters]]\nkey = "{KEY}"\n']
    tables += [f'[[views]]\nreference = "photograph.exr"\nmask = "mask.png"\nsensor = {i}\n' for i in range(views)]
    file = folder / "problem.toml"
    file.write_text('scene = "scene.xml"\nmax_depth = 2\nloss = "L1"\n' + "\n".join(tables), encoding="utf-8")
    return file


def peak(views: int, side: int, pixels: int, steps: int) -> dict[str, float]:
    """Bytes, of this process: once the problem is read, and after the steps."""
    ur.use()
    with tempfile.TemporaryDirectory() as scratch:
        problem = ur.Problem.from_file(write(Path(scratch), views, side))
        read = 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        estimator = ur.PathGradient(pixels=ur.pixels.Uniform(pixels), spp=2)
        ur.optimize(problem, estimator, ur.optimizers.Adam(0.02), steps=steps, run_directory=Path(scratch) / "run")
    return {"read": read, "run": 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}


def run(views: tuple[int, ...] = (20, 200), side: int = 2000, pixels: int = 16384, steps: int = 20) -> dict[str, Any]:
    """Bytes.

    Args:
        views: photographs
        side: pixels along a side of each
        pixels: of a step
    """
    found = {}
    for count in views:
        found[str(count)] = in_new_process(peak, count, side, pixels, steps)
        print(count, {name: f"{size / 1e6:.0f} MB" for name, size in found[str(count)].items()}, flush=True)
    return {"peaks": found, "side": side, "pixels": pixels}
