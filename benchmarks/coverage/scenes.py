"""A small scene for each plugin of the Mitsuba wheel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.internals import mi

__all__ = ["PLUGINS", "Plugin", "wheel"]

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
    """

    kind: str
    build: Build
    prefixes: tuple[str, ...] = ()
    aborts: bool = False


def wheel() -> list[str]:
    """The names of all plugins of the installed wheel."""
    folder = Path(str(mi.__file__)).parent / "plugins"
    return sorted({path.name.partition(".")[0].removeprefix("lib") for path in folder.iterdir()})


def colour(*values: float) -> Description:
    return {"type": "rgb", "value": list(values)}


def bitmap(seed: int = 2, channels: int = 3, low: float = 0.2, high: float = 0.8) -> Description:
    values = np.random.default_rng(seed).uniform(low, high, (4, 4, channels)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}


def grid(channels: int = 1, low: float = 0.2, high: float = 0.8) -> Description:
    values = np.random.default_rng(3).uniform(low, high, (3, 3, 3, channels)).astype(np.float32)
    return {"type": "gridvolume", "grid": mi.VolumeGrid(values), "raw": True, "to_world": _unit_cube()}


def _unit_cube() -> Any:
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


def _bsdf(kind: str, **own: Any) -> Plugin:
    return Plugin("BSDF", material({"type": kind, **own}), ("ball.bsdf",))


def _texture(kind: str, make: Callable[[], Description] | None = None, **own: Any) -> Plugin:
    return Plugin("texture", texture(make or (lambda: {"type": kind, **own})), ("ball.bsdf.reflectance",))


def _emitter(kind: str, place: Callable[[], Any] | None = None, **own: Any) -> Plugin:
    def build(folder: Path) -> Description:
        given = _copy({"type": kind, **own})
        if place is not None:
            given["to_world"] = place()
        return scene(lamp=None, sky=None, light=given)

    return Plugin("emitter", build, ("light",))


def _area(kind: str, **own: Any) -> Plugin:
    def build(folder: Path) -> Description:
        found = scene(sky=None)
        found["lamp"]["emitter"] = _copy({"type": kind, **own})
        return found

    return Plugin("emitter", build, ("lamp.emitter",))


def _shape(kind: str, aborts: bool = False, **own: Any) -> Plugin:
    def build(folder: Path) -> Description:
        bsdf = {"type": "diffuse", "reflectance": colour(0.6, 0.4, 0.3)}
        given = {key: value(folder) if callable(value) else value for key, value in own.items()}
        return scene(ball={"type": kind, "bsdf": bsdf, **given})

    return Plugin("shape", build, ("ball",), aborts)


def _mesh_file(ending: str) -> Callable[[Path], str]:
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


def _serialized(folder: Path) -> str:
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


def _curve(folder: Path) -> str:
    points = [(-1.0, 0.2), (-0.6, -0.3), (-0.2, 0.3), (0.2, -0.3), (0.6, 0.3), (1.0, -0.2)]
    path = folder / "curve.txt"
    path.write_text("\n".join(f"{x} {y} 0 0.2" for x, y in points) + "\n")
    return str(path)


def _ellipsoids(folder: Path) -> Any:
    row = [0, 0, 0, 0.6, 0.4, 0.5, 0, 0, 0, 1], [0.6, 0.3, 0, 0.2, 0.3, 0.2, 0, 0, 0, 1]
    return mi.TensorXf(np.array(row, np.float32))


def _distance(folder: Path) -> Any:
    axis = np.linspace(-0.5, 0.5, 6)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    return mi.TensorXf((np.sqrt(x * x + y * y + z * z) - 0.35).astype(np.float32)[..., None])


def _centred(folder: Path) -> Any:
    return _unit_cube()


def _attribute(folder: Path) -> Description:
    def mesh() -> Any:
        bsdf = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
        made: Any = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.5), "bsdf": bsdf})
        values = np.random.default_rng(1).uniform(0.1, 0.9, made.vertex_count() * 3)
        made.add_attribute("vertex_color", 3, values.astype(np.float32))
        return made

    return scene(ball=mesh())


def _group(folder: Path) -> Description:
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


def _merge(folder: Path) -> Description:
    part = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.4), "bsdf": {"type": "diffuse"}}
    return scene(
        ball={
            "type": "merge",
            "a": part,
            "b": {**part, "to_world": mi.ScalarTransform4f().translate([1, 0, 0]).scale(0.3)},
        }
    )


def _measured(polarized: bool) -> Build:
    def build(folder: Path) -> Description:
        path = folder / "measured.bsdf"
        path.write_bytes(b"tensor_file\0\1\0" + b"\0" * 8)
        return scene(
            ball={
                "type": "sphere",
                "bsdf": {"type": "measured_polarized" if polarized else "measured", "filename": str(path)},
            }
        )

    return build


def _medium(kind: str, **own: Any) -> Plugin:
    return Plugin("medium", _fog({"type": kind, **own}), ("ball.interior_medium",))


def _phase(kind: str, **own: Any) -> Plugin:
    medium = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 1.5, "phase": {"type": kind, **own}}
    return Plugin("phase function", _fog(medium), ("ball.interior_medium.phase_function",))


def _volume(make: Callable[[], Description]) -> Plugin:
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


def _sensor(kind: str, **own: Any) -> Plugin:
    return Plugin("sensor", lambda folder: scene(camera=sensor(kind, **_copy(own))), ("camera",))


def _meter(kind: str, **own: Any) -> Plugin:
    def build(folder: Path) -> Description:
        place = {} if "direction" in own else {"to_world": view()}
        return scene(camera={"type": kind, "film": film(width=1, height=1), **place, **own})

    return Plugin("sensor", build, ("camera",))


def _irradiance(folder: Path) -> Description:
    plate = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 2]),
        "camera": {"type": "irradiancemeter", "film": film()},
    }
    return scene(camera=None, plate=plate)


def _batch(folder: Path) -> Description:
    left = sensor(to_world=view() @ mi.ScalarTransform4f().translate([0.3, 0, 0]))
    return scene(camera={"type": "batch", "left": left, "right": sensor(), "film": film(width=2 * SIZE)})


def _filter(kind: str) -> Plugin:
    return Plugin("filter", lambda folder: scene(camera=sensor(film=film(rfilter={"type": kind}))), ("floor.bsdf",))


def _sampler(kind: str) -> Plugin:
    return Plugin(
        "sampler", lambda folder: scene(camera=sensor(sampler={"type": kind, "sample_count": 16})), ("floor.bsdf",)
    )


def _integrator(kind: str, **own: Any) -> Plugin:
    return Plugin("integrator", lambda folder: scene(integrator=_copy({"type": kind, **own})), ("floor.bsdf",))


def _pointing() -> Any:
    return mi.ScalarTransform4f().look_at([1.5, 2.5, 3], [0, 0, 0], [0, 1, 0])


def _sky(seed: int = 5) -> Any:
    return mi.Bitmap(np.random.default_rng(seed).uniform(0.2, 1.5, (4, 8, 3)).astype(np.float32))


_PATH = {"type": "path", "max_depth": 6}
_SGGX = np.tile(np.array([0.3, 0.4, 0.5, 0, 0, 0], np.float32), (2, 2, 2, 1))

PLUGINS: dict[str, Plugin] = {
    "aov": _integrator("aov", aovs="depth:depth", image=_PATH),
    "area": _area("area", radiance=colour(6.0, 5.0, 4.0)),
    "batch": Plugin("sensor", _batch, ("camera",)),
    "bitmap": _texture("bitmap", bitmap),
    "blackbody": _texture("blackbody", temperature=3000.0),
    "blendbsdf": _bsdf("blendbsdf", weight=0.4, a={"type": "diffuse"}, b={"type": "roughconductor", "alpha": 0.3}),
    "blender": Plugin("shape", lambda folder: scene(ball={"type": "blender"}), ("ball",), True),
    "blendphase": _phase("blendphase", weight=0.4, a={"type": "isotropic"}, b={"type": "hg", "g": 0.4}),
    "box": _filter("box"),
    "bsplinecurve": _shape("bsplinecurve", filename=_curve, aborts=True),
    "bumpmap": _bsdf("bumpmap", t=lambda: bitmap(3, 1), b={"type": "diffuse"}, scale=0.1),
    "catmullrom": _filter("catmullrom"),
    "checkerboard": _texture("checkerboard", color0=colour(0.2, 0.3, 0.4), color1=colour(0.8, 0.6, 0.5)),
    "circular": _bsdf("circular"),
    "conductor": _bsdf("conductor", specular_reflectance=colour(0.8, 0.7, 0.6)),
    "constant": _emitter("constant", radiance=colour(0.8, 0.9, 1.0)),
    "constvolume": _volume(lambda: {"type": "constvolume", "value": 0.7}),
    "cube": _shape("cube", to_world=_centred),
    "cylinder": _shape("cylinder", radius=0.5, p0=[-0.6, 0, 0], p1=[0.6, 0, 0]),
    "d65": _area("area", radiance={"type": "d65", "scale": 5.0}),
    "depth": _integrator("depth"),
    "dielectric": _bsdf("dielectric", specular_transmittance=colour(0.9, 0.8, 0.7)),
    "diffuse": _bsdf("diffuse", reflectance=bitmap),
    "direct": _integrator("direct"),
    "directional": _emitter("directional", _pointing, irradiance=colour(2.0, 1.5, 1.0)),
    "directionalarea": _area("directionalarea", radiance=colour(6.0, 5.0, 4.0)),
    "disk": _shape("disk", to_world=_centred),
    "distant": _meter("distant", direction=[0, -1, 0]),
    "ellipsoids": _shape("ellipsoids", data=_ellipsoids, aborts=True),
    "ellipsoidsmesh": _shape("ellipsoidsmesh", data=_ellipsoids, aborts=True),
    "envmap": Plugin("emitter", lambda folder: scene(lamp=None, sky={"type": "envmap", "bitmap": _sky()}), ("sky",)),
    "gaussian": _filter("gaussian"),
    "gridvolume": _volume(grid),
    "hair": _bsdf("hair", eumelanin=0.3, pheomelanin=0.2),
    "hair, absorption": _bsdf("hair", sigma_a=colour(0.2, 0.3, 0.4)),
    "hdrfilm": Plugin("film", lambda folder: scene(), ("floor.bsdf",)),
    "heterogeneous": _medium("heterogeneous", albedo=lambda: grid(3), sigma_t=grid, scale=2.0),
    "hg": _phase("hg", g=0.4),
    "homogeneous": _medium("homogeneous", albedo=colour(0.8, 0.7, 0.6), sigma_t=1.5),
    "independent": _sampler("independent"),
    "instance": Plugin("shape", _group, ("group", "copy_0", "copy_1")),
    "irradiancemeter": Plugin("sensor", _irradiance, ("plate", "camera")),
    "irregular": _texture("irregular", wavelengths="400,500,700", values="0.2,0.4,0.6"),
    "isotropic": _phase("isotropic"),
    "lanczos": _filter("lanczos"),
    "ldsampler": _sampler("ldsampler"),
    "linearcurve": _shape("linearcurve", filename=_curve, aborts=True),
    "mask": _bsdf("mask", opacity=0.6, b={"type": "diffuse"}),
    "measured": Plugin("BSDF", _measured(False), ("ball.bsdf",)),
    "measured_polarized": Plugin("BSDF", _measured(True), ("ball.bsdf",)),
    "merge": Plugin("shape", _merge, ("ball",)),
    "mesh_attribute": Plugin("texture", _attribute, ("ball",)),
    "mitchell": _filter("mitchell"),
    "moment": _integrator("moment", image=_PATH),
    "multijitter": _sampler("multijitter"),
    "normalmap": _bsdf("normalmap", normalmap=lambda: bitmap(4, 3, 0.45, 0.55), b={"type": "roughconductor", "alpha": 0.3}),
    "null": _bsdf("null"),
    "obj": _shape("obj", filename=_mesh_file("obj")),
    "orthogonal": _sampler("orthogonal"),
    "orthographic": _sensor("orthographic"),
    "path": _integrator("path", max_depth=6),
    "perspective": _sensor("perspective"),
    "plastic": _bsdf("plastic", diffuse_reflectance=colour(0.6, 0.4, 0.3), specular_reflectance=colour(0.8, 0.9, 1.0)),
    "ply": _shape("ply", filename=_mesh_file("ply")),
    "point": _emitter("point", position=[1.0, 2.0, 2.0], intensity=colour(9.0, 8.0, 6.0)),
    "polarizer": _bsdf("polarizer"),
    "pplastic": _bsdf("pplastic", diffuse_reflectance=colour(0.6, 0.4, 0.3), alpha=0.3),
    "principled": _bsdf(
        "principled", base_color=bitmap, roughness=0.4, metallic=0.3, anisotropic=0.2, eta=1.5, spec_tint=0.2, sheen=0.3,
        sheen_tint=0.3, clearcoat=0.4, clearcoat_gloss=0.5, flatness=0.2, spec_trans=0.3,
    ),
    "principled, specular": _bsdf("principled", base_color=bitmap, specular=0.4, roughness=0.4),
    "principledthin": _bsdf(
        "principledthin", base_color=bitmap, roughness=0.4, anisotropic=0.2, eta=1.5, spec_tint=0.2, sheen=0.3,
        sheen_tint=0.3, flatness=0.2, spec_trans=0.3, diff_trans=0.6,
    ),
    "projector": _emitter("projector", _pointing, irradiance=bitmap, scale=9.0, fov=50.0),
    "ptracer": _integrator("ptracer"),
    "radiancemeter": _meter("radiancemeter"),
    "rawconstant": _texture("rawconstant", value=[0.5, 0.4, 0.3]),
    "rayleigh": _phase("rayleigh"),
    "rectangle": _shape("rectangle", to_world=_centred),
    "regular": _texture("regular", wavelength_min=400.0, wavelength_max=700.0, values="0.2,0.4,0.6"),
    "retarder": _bsdf("retarder"),
    "roughconductor": _bsdf("roughconductor", alpha_u=0.3, alpha_v=0.2, specular_reflectance=colour(0.8, 0.7, 0.6)),
    "roughdielectric": _bsdf("roughdielectric", alpha=0.3, specular_transmittance=colour(0.9, 0.8, 0.7)),
    "roughdielectric, anisotropic": _bsdf("roughdielectric", alpha_u=0.3, alpha_v=0.2, int_ior=1.0, ext_ior=1.4),
    "roughplastic": _bsdf("roughplastic", alpha=0.3, diffuse_reflectance=colour(0.6, 0.4, 0.3)),
    "sdfgrid": _shape("sdfgrid", grid=_distance, to_world=_centred, aborts=True),
    "serialized": _shape("serialized", filename=_serialized),
    "sggx": _phase("sggx", S=lambda: {"type": "gridvolume", "grid": mi.VolumeGrid(_SGGX), "raw": True, "to_world": _unit_cube()}),
    "shapegroup": Plugin("shape", _group, ("group",)),
    "specfilm": Plugin("film", lambda folder: scene(camera=sensor(film=film(type="specfilm"))), ("floor.bsdf",)),
    "sphere": _shape("sphere", radius=0.7),
    "spot": _emitter("spot", _pointing, intensity=colour(20.0, 16.0, 12.0), cutoff_angle=30.0, beam_width=15.0),
    "srgb": _texture("rgb", value=[0.5, 0.4, 0.3]),
    "stokes": _integrator("stokes", image=_PATH),
    "stratified": _sampler("stratified"),
    "sunsky": _emitter("sunsky", turbidity=4.0),
    "sunsky, direction": _emitter("sunsky", turbidity=4.0, sun_direction=[0.3, 0.8, 0.5]),
    "tabphase": _phase("tabphase", values="0.5, 1.0, 1.5"),
    "tent": _filter("tent"),
    "thindielectric": _bsdf("thindielectric", specular_transmittance=colour(0.9, 0.8, 0.7)),
    "thinlens": _sensor("thinlens", aperture_radius=0.2, focus_distance=4.0),
    "timed_sunsky": _emitter("timed_sunsky", turbidity=4.0),
    "twosided": _bsdf("twosided", b={"type": "diffuse", "reflectance": bitmap}),
    "uniform": _texture("uniform", value=0.4),
    "volpath": _integrator("volpath", max_depth=6),
    "volpathmis": _integrator("volpathmis", max_depth=6),
    "volume": _texture("volume", lambda: {"type": "volume", "volume": grid()}),
}  # fmt: skip
"""{name: its scene}, all plugins of the wheel of Mitsuba 3.9.1. After a comma, a name says how the plugin differs from its first scene."""
