"""An asset made for tests: nothing in it is symmetric, and half of its texture lies mirrored.

Written as others write them (OBJ with v upwards), so that conventions are Mitsuba's own, not those of the code that is tested.
"""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

import unrender as ur
from unrender.scene.problem import Problem

WIDTH, HEIGHT = 40, 30
_TEXELS = 64
KEYS = [
    f"body.bsdf.brdf_0.{name}.data"
    for name in ("normalmap", "nested_bsdf.base_color", "nested_bsdf.roughness", "nested_bsdf.metallic")
]


def write(folder: Path) -> Problem:
    """The asset as a problem whose initial values are its maps; `folder` exists."""
    _mesh(folder / "body.obj")
    for name, pixels in _maps().items():
        mi.Bitmap(pixels.astype(np.float32)).write(str(folder / f"{name}.exr"))
    (folder / "scene.xml").write_text(_SCENE.replace("WIDTH", str(WIDTH)).replace("HEIGHT", str(HEIGHT)))
    parameters = [ur.Parameter(key) for key in [*KEYS, "light.data"]]
    views = [ur.View(np.zeros((HEIGHT, WIDTH, 3), np.float32), sensor=0)]
    return ur.Problem(folder / "scene.xml", parameters, views, max_depth=3)


def _mesh(path: Path) -> None:
    rows, columns = 24, 48
    u, v = np.meshgrid(np.arange(columns + 1) / columns, np.arange(rows + 1) / rows)
    theta, phi = np.pi * v, 2 * np.pi * u
    x, y, z = np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)
    radius = 1 + 0.3 * np.exp(-6 * ((x - 0.8) ** 2 + (y - 0.5) ** 2)) - 0.2 * y
    points = np.stack([1.1 * x, 0.9 * y, 0.7 * z], -1) * radius[..., None] + [0.3, -0.2, 0.5]
    lines = [f"v {a:.7f} {b:.7f} {c:.7f}" for a, b, c in points.reshape(-1, 3)]
    lines += [f"vt {0.02 + 0.96 * a:.7f} {0.98 - 0.96 * b:.7f}" for a, b in np.stack([u, v], -1).reshape(-1, 2)]
    half = columns // 2  # the second half lies mirrored, from right to left
    lines += [f"vt {0.02 + 0.96 * (1.5 - a):.7f} {0.98 - 0.96 * b:.7f}" for a, b in np.stack([u, v], -1).reshape(-1, 2)]
    for row in range(rows):
        for column in range(columns):
            a = row * (columns + 1) + column + 1
            b, c, d = a + 1, a + columns + 1, a + columns + 2
            more = (columns + 1) * (rows + 1) if column >= half else 0
            lines += [
                f"f {a}/{a + more} {b}/{b + more} {d}/{d + more}",
                f"f {a}/{a + more} {d}/{d + more} {c}/{c + more}",
            ]
    path.write_text("\n".join(lines) + "\n")


def _maps() -> dict[str, np.ndarray]:
    y, x = (np.mgrid[:_TEXELS, :_TEXELS] + 0.5) / _TEXELS
    colour = np.stack([0.15 + 0.7 * x, 0.1 + 0.6 * y, 0.5 - 0.4 * x * y], -1)
    colour[8:20, 5:9] = colour[8:11, 5:16] = [0.9, 0.9, 0.1]  # an F without its middle
    roughness = (0.2 + 0.5 * x)[..., None]
    metallic = np.where(y > 0.55, 0.9, 0.0)[..., None]
    normal = np.stack([0.25 + 0.15 * np.sin(9 * x), 0.35 * np.cos(7 * y + 1), np.ones_like(x)], -1)
    normal = 0.5 + 0.5 * normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    light = np.full((16, 32, 3), [0.15, 0.2, 0.3])
    light[3:6, 4:9] = [6, 4, 2]
    light[9:12, 20:22] = [1, 5, 2]
    return {"colour": colour, "roughness": roughness, "metallic": metallic, "normal": normal, "light": light}


def _texture(name: str, file: str) -> str:
    return (
        f'<texture type="bitmap" name="{name}"><string name="filename" value="{file}.exr"/><boolean name="raw" value="true"/>'
        '<string name="format" value="variant"/><string name="wrap_mode" value="clamp"/></texture>'
    )


_SCENE = f"""<scene version="3.0.0">
<sensor type="perspective" id="camera">
  <float name="fov" value="38"/><string name="fov_axis" value="x"/>
  <float name="principal_point_offset_x" value="0.06"/><float name="principal_point_offset_y" value="-0.09"/>
  <transform name="to_world"><lookat origin="2.6, 1.1, 3.4" target="0.3, -0.2, 0.5" up="0.2, 1, 0.1"/></transform>
  <film type="hdrfilm"><integer name="width" value="WIDTH"/><integer name="height" value="HEIGHT"/><rfilter type="box"/></film>
</sensor>
<emitter type="envmap" id="light"><string name="filename" value="light.exr"/><float name="scale" value="1.5"/>
  <transform name="to_world"><rotate x="0.48" y="0.8" z="0.36" angle="70"/></transform></emitter>
<shape type="obj" id="body"><string name="filename" value="body.obj"/>
  <bsdf type="twosided"><bsdf type="normalmap">{_texture("normalmap", "normal")}
    <bsdf type="principled">{_texture("base_color", "colour")}{_texture("roughness", "roughness")}{_texture("metallic", "metallic")}</bsdf>
  </bsdf></bsdf></shape>
</scene>"""
