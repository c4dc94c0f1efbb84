"""A small scene for each plugin of the Mitsuba wheel."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.internals import mi

SIZE = 16
Description = dict[str, Any]
Build = Callable[[Path], Description]
"""From a folder for files to a scene."""


@dataclass(frozen=True)
class Plugin:
    """One plugin, in a scene.

    Attributes:
        kind: of plugin, such as "BSDF".
        build: makes the scene.
        prefixes: of the keys that belong to the plugin, in the scene.
        aborts: whether Mitsuba itself may end the process, so that a process of its own is needed.
        instanced: whether the plugin is in a shapegroup with two instances. Its first parameters are measured, with fewer samples.
    """

    kind: str
    build: Build
    prefixes: tuple[str, ...] = ()
    aborts: bool = False
    instanced: bool = False


def wheel() -> list[str]:
    """The names of all plugins of the installed wheel."""
    folder = Path(str(mi.__file__)).parent / "plugins"
    return sorted({path.name.partition(".")[0].removeprefix("lib") for path in folder.iterdir()})


def colour(*values: float) -> Description:
    return {"type": "rgb", "value": list(values)}


def bitmap(seed: int = 2, channels: int = 3, low: float = 0.2, high: float = 0.8) -> Description:
    values = np.random.default_rng(seed).uniform(low, high, (4, 4, channels)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}


def normals(seed: int = 4) -> Description:
    """Directions up to 0.3 beside the surface's own, of length 1."""
    beside = np.random.default_rng(seed).uniform(-0.3, 0.3, (4, 4, 2))
    upwards = np.sqrt(1 - (beside**2).sum(-1, keepdims=True))
    values = 0.5 + 0.5 * np.concatenate([beside, upwards], axis=-1)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values.astype(np.float32)), "raw": True}


def grid(channels: int = 1, low: float = 0.2, high: float = 0.8) -> Description:
    values = np.random.default_rng(3).uniform(low, high, (3, 3, 3, channels)).astype(np.float32)
    return {"type": "gridvolume", "grid": mi.VolumeGrid(values), "raw": True, "to_world": unit_cube()}


def unit_cube() -> Any:
    return mi.ScalarTransform4f().translate([-0.7, -0.7, -0.7]).scale(1.4)


def film(**own: Any) -> Description:
    return {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, **own}


def view() -> Any:
    return mi.ScalarTransform4f().look_at([0, 1.2, 4], [0, 0, 0], [0, 1, 0])


def sensor(kind: str = "perspective", **own: Any) -> Description:
    lens = {"fov": 40.0} if kind in ("perspective", "thinlens") else {}
    return {"type": kind, "to_world": view(), "film": film(), **lens, **own}


def scene(**parts: Any) -> Description:
    """A textured floor, a ball, a bright sky and a lamp; `parts` replace these or come on top. None leaves a part out."""
    to = mi.ScalarTransform4f
    found = {
        "type": "scene",
        "camera": sensor(),
        "floor": {
            "type": "rectangle",
            "to_world": to().translate([0, -0.8, 0]).rotate([1, 0, 0], -90).scale(3),
            "bsdf": {"type": "diffuse", "reflectance": bitmap(1)},
        },
        "ball": {"type": "sphere", "radius": 0.7, "bsdf": {"type": "diffuse", "reflectance": colour(0.6, 0.4, 0.3)}},
        "sky": {"type": "constant", "radiance": colour(0.8, 0.9, 1.0)},
        "lamp": {
            "type": "rectangle",
            "to_world": to().look_at([1.5, 2.5, 2], [0, 0, 0], [0, 1, 0]).scale(0.5),
            "emitter": {"type": "area", "radiance": colour(6.0, 5.0, 4.0)},
        },
        **parts,
    }
    return {key: value for key, value in found.items() if value is not None}


def material(bsdf: Description) -> Build:
    return lambda folder: scene(ball={"type": "sphere", "radius": 0.7, "bsdf": _copy(bsdf)})


def texture(texture: Callable[[], Description]) -> Build:
    return lambda folder: scene(
        ball={
            "type": "cube",
            "to_world": mi.ScalarTransform4f().scale(0.5),
            "bsdf": {"type": "diffuse", "reflectance": texture()},
        }
    )


def _copy(description: Description) -> Description:
    return {
        key: value() if callable(value) else _copy(value) if isinstance(value, dict) else value
        for key, value in description.items()
    }


def bsdf(kind: str, **own: Any) -> Plugin:
    return Plugin("BSDF", material({"type": kind, **own}), ("ball.bsdf",))


def textured(kind: str, make: Callable[[], Description] | None = None, **own: Any) -> Plugin:
    return Plugin("texture", texture(make or (lambda: {"type": kind, **own})), ("ball.bsdf.reflectance",))


def emitting(kind: str, place: Callable[[], Any] | None = None, **own: Any) -> Plugin:
    def build(folder: Path) -> Description:
        given = _copy({"type": kind, **own})
        if place is not None:
            given["to_world"] = place()
        return scene(lamp=None, sky=None, light=given)

    return Plugin("emitter", build, ("light",))


def area(kind: str, **own: Any) -> Plugin:
    def build(folder: Path) -> Description:
        found = scene(sky=None)
        found["lamp"]["emitter"] = _copy({"type": kind, **own})
        return found

    return Plugin("emitter", build, ("lamp.emitter",))


def shaped(kind: str, aborts: bool = False, **own: Any) -> Plugin:
    def build(folder: Path) -> Description:
        bsdf = {"type": "diffuse", "reflectance": colour(0.6, 0.4, 0.3)}
        given = {key: value(folder) if callable(value) else value for key, value in own.items()}
        return scene(ball={"type": kind, "bsdf": bsdf, **given})

    return Plugin("shape", build, ("ball",), aborts)


def mesh_file(ending: str) -> Callable[[Path], str]:
    def write(folder: Path) -> str:
        path = folder / f"mesh.{ending}"
        mesh: Any = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.5)})
        if ending == "ply":
            mesh.write_ply(str(path))
        elif ending == "obj":
            points, faces = (
                np.array(mesh.vertex_positions_buffer()).reshape(-1, 3),
                np.array(mesh.faces_buffer()).reshape(-1, 3),
            )
            lines = [f"v {x} {y} {z}" for x, y, z in points] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
            path.write_text("\n".join(lines) + "\n")
        return str(path)

    return write


def serialized(folder: Path) -> str:
    """A file of Mitsuba's binary format, version 4, with one mesh."""
    import struct
    import zlib

    mesh: Any = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.5)})
    points, faces = np.array(mesh.vertex_positions_buffer()), np.array(mesh.faces_buffer()).astype(np.uint32)
    body = struct.pack("<I", 0x1000) + b"cube\0" + struct.pack("<QQ", len(points) // 3, len(faces) // 3)
    body += points.astype("<f4").tobytes() + faces.astype("<u4").tobytes()
    data = struct.pack("<HH", 0x041C, 4) + zlib.compress(body)
    path = folder / "mesh.serialized"
    path.write_bytes(data + struct.pack("<Q", 0) + struct.pack("<I", 1))
    return str(path)


def curve_file(folder: Path) -> str:
    points = [(-1.0, 0.2), (-0.6, -0.3), (-0.2, 0.3), (0.2, -0.3), (0.6, 0.3), (1.0, -0.2)]
    path = folder / "curve.txt"
    path.write_text("\n".join(f"{x} {y} 0 0.2" for x, y in points) + "\n")
    return str(path)


def ellipsoids(folder: Path) -> Any:
    row = [0, 0, 0, 0.6, 0.4, 0.5, 0, 0, 0, 1], [0.6, 0.3, 0, 0.2, 0.3, 0.2, 0, 0, 0, 1]
    return mi.TensorXf(np.array(row, np.float32))


def distances(folder: Path) -> Any:
    axis = np.linspace(-0.5, 0.5, 6)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    box = np.maximum(np.maximum(abs(x) - 0.35, abs(y) - 0.25), abs(z) - 0.15)  # a ball would hide rotations
    return mi.TensorXf(box.astype(np.float32)[..., None])


def centred(folder: Path) -> Any:
    return unit_cube()


def halved(folder: Path) -> Any:
    return mi.ScalarTransform4f().scale(0.5)


def attribute(folder: Path) -> Description:
    def mesh() -> Any:
        bsdf = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
        made: Any = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.5), "bsdf": bsdf})
        values = np.random.default_rng(1).uniform(0.1, 0.9, made.vertex_count() * 3)
        made.add_attribute("vertex_color", 3, values.astype(np.float32))
        return made

    return scene(ball=mesh())


def group(folder: Path) -> Description:
    to = mi.ScalarTransform4f
    group = {
        "type": "shapegroup",
        "part": {"type": "sphere", "radius": 0.4, "bsdf": {"type": "diffuse", "reflectance": colour(0.6, 0.4, 0.3)}},
    }
    places = {
        f"copy_{n}": {"type": "instance", "to_world": to().translate([x, 0, 0]), "g": {"type": "ref", "id": "group"}}
        for n, x in enumerate((-0.5, 0.6))
    }
    return scene(ball=None, group=group, **places)


def in_instances(plugin: Plugin) -> Plugin:
    """Return the plugin with its shape in a shapegroup that two instances show."""
    name = plugin.prefixes[0].partition(".")[0]

    def build(folder: Path) -> Description:
        found = plugin.build(folder)
        place = mi.ScalarTransform4f
        copies = {
            f"copy_{n}": {
                "type": "instance",
                "to_world": place().translate([x, 0, 0]).scale(size),
                "g": {"type": "ref", "id": "group"},
            }
            for n, (x, size) in enumerate(((-0.6, 0.8), (0.7, 0.6)))
        }
        part = found.pop(name)
        return {**found, "group": {"type": "shapegroup", "part": part}, **copies}

    inside = tuple(prefix.replace(name, "group.part", 1) for prefix in plugin.prefixes)
    return Plugin(plugin.kind, build, inside, plugin.aborts, instanced=True)


def merge(folder: Path) -> Description:
    part = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.4), "bsdf": {"type": "diffuse"}}
    return scene(
        ball={
            "type": "merge",
            "a": part,
            "b": {**part, "to_world": mi.ScalarTransform4f().translate([1, 0, 0]).scale(0.3)},
        }
    )


_ANGLES, _PARTS = 4, 8
_MEASURED = {
    "description": np.frombuffer(b"grey", np.uint8),
    "phi_i": np.zeros(1, np.float32),
    "theta_i": np.linspace(0.0, 0.5 * np.pi, _ANGLES, dtype=np.float32),
    "ndf": np.ones((2, _PARTS), np.float32),
    "sigma": np.ones((2, _PARTS), np.float32),
    "vndf": np.ones((1, _ANGLES, _PARTS, _PARTS), np.float32),
    "rgb": np.full((1, _ANGLES, 3, _PARTS, _PARTS), 0.3, np.float32),
    "luminance": np.ones((1, _ANGLES, _PARTS, _PARTS), np.float32),
    "jacobian": np.ones(1, np.uint8),
}
"""Fields of a grey, isotropic measurement (Dupuy and Jakob 2018)."""


def tensor_file(fields: Mapping[str, np.ndarray]) -> bytes:
    """Return Mitsuba's tensor file of arrays of bytes and of single precision."""
    kinds, head, body = {"uint8": 1, "float32": 10}, b"tensor_file\0\1\0" + struct.pack("<I", len(fields)), b""
    start = len(head) + sum(13 + len(name) + 8 * x.ndim for name, x in fields.items())
    for name, x in fields.items():
        head += struct.pack("<H", len(name)) + name.encode()
        head += struct.pack("<HBQ", x.ndim, kinds[str(x.dtype)], start + len(body))
        head += struct.pack(f"<{x.ndim}Q", *x.shape)
        body += x.tobytes()
    return head + body


def measured(polarized: bool) -> Build:
    def build(folder: Path) -> Description:
        path = folder / "measured.bsdf"
        path.write_bytes(tensor_file(_MEASURED))
        return scene(
            ball={
                "type": "sphere",
                "bsdf": {"type": "measured_polarized" if polarized else "measured", "filename": str(path)},
            }
        )

    return build


def filled(kind: str, **own: Any) -> Plugin:
    return Plugin("medium", _fog({"type": kind, **own}), ("ball.interior_medium",))


def phase(kind: str, **own: Any) -> Plugin:
    medium = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 1.5, "phase": {"type": kind, **own}}
    return Plugin("phase function", _fog(medium), ("ball.interior_medium.phase_function",))


def density(make: Callable[[], Description]) -> Plugin:
    medium = {"type": "heterogeneous", "albedo": 0.8, "sigma_t": make, "scale": 2.0}
    return Plugin("volume", _fog(medium), ("ball.interior_medium.sigma_t",))


def _fog(medium: Description) -> Build:
    return lambda folder: scene(
        ball={
            "type": "cube",
            "to_world": mi.ScalarTransform4f().scale(0.7),
            "bsdf": {"type": "null"},
            "interior": _copy(medium),
        }
    )


def seen_by(kind: str, **own: Any) -> Plugin:
    return Plugin("sensor", lambda folder: scene(camera=sensor(kind, **_copy(own))), ("camera",))


def metered(kind: str, **own: Any) -> Plugin:
    def build(folder: Path) -> Description:
        place = {} if "direction" in own else {"to_world": view()}
        return scene(camera={"type": kind, "film": film(width=1, height=1), **place, **own})

    return Plugin("sensor", build, ("camera",))


def irradiance(folder: Path) -> Description:
    plate = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 2]),
        "camera": {"type": "irradiancemeter", "film": film()},
    }
    return scene(camera=None, plate=plate)


def batch(folder: Path) -> Description:
    left = sensor(to_world=view() @ mi.ScalarTransform4f().translate([0.3, 0, 0]))
    return scene(camera={"type": "batch", "left": left, "right": sensor(), "film": film(width=2 * SIZE)})


def filtered(kind: str) -> Plugin:
    return Plugin("filter", lambda folder: scene(camera=sensor(film=film(rfilter={"type": kind}))), ("floor.bsdf",))


def sampled(kind: str) -> Plugin:
    return Plugin(
        "sampler", lambda folder: scene(camera=sensor(sampler={"type": kind, "sample_count": 16})), ("floor.bsdf",)
    )


def integrated(kind: str, **own: Any) -> Plugin:
    return Plugin("integrator", lambda folder: scene(integrator=_copy({"type": kind, **own})), ("floor.bsdf",))


def pointing() -> Any:
    return mi.ScalarTransform4f().look_at([1.5, 2.5, 3], [0, 0, 0], [0, 1, 0])


def sky_map(seed: int = 5) -> Any:
    return mi.Bitmap(np.random.default_rng(seed).uniform(0.2, 1.5, (4, 8, 3)).astype(np.float32))
