"""Look for paths whose radiance, or whose derivative, is not finite: over materials, emitters, sensors and media.

    python tests/statistical/nonfinite_hunt.py --paths 1e8            # images, the paths shared by all subjects
    python tests/statistical/nonfinite_hunt.py --paths 1e7 --replays  # pairs and their adjoints too

Every non-finite path is printed with its subject, seed, pixel and sample. The exit status is 1 where there is one.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import fog
import mitsuba as mi
import numpy as np
import zoo

from unrender.rendering.mitsuba.renderer import MitsubaRenderer
from unrender.rendering.renderer import SampleRequest

LANES = 1 << 20
DEPTH = 6


def to() -> Any:
    return mi.ScalarTransform4f()


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def with_emitter(**emitters: dict[str, Any]) -> Callable[[], dict[str, Any]]:
    """The zoo's scene with other light, a glossy ball, and walls in the plane of the lamp."""

    def made() -> dict[str, Any]:
        found = zoo.scene(zoo.rough(), environment=False)
        del found["lamp"]
        wall = {"type": "rectangle", "to_world": to().translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(4)}
        return {**found, "wall": {**wall, "bsdf": {"type": "twosided", "b": {"type": "diffuse"}}}, **emitters}

    return made


def lamp(shape: str, radiance: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """A shape that emits, inside the scene and level with other geometry."""
    place = to().translate([0.3, 0.5, 2.9]).rotate([1, 0, 0], 180).scale(0.35)
    return {
        "type": shape,
        "to_world": place,
        "emitter": {"type": "area", "radiance": radiance or rgb(18, 15, 11)},
        **more,
    }


def sky() -> dict[str, Any]:
    values = np.random.default_rng(5).uniform(0, 1.5, (8, 16, 3)).astype(np.float32)
    values[3, 4] = 5000
    return {"type": "envmap", "bitmap": mi.Bitmap(values)}


EMITTERS: dict[str, Callable[[], dict[str, dict[str, Any]]]] = {
    "rectangle and environment": lambda: {"lamp": lamp("rectangle"), "sky": sky()},
    "disk and constant": lambda: {"lamp": lamp("disk"), "sky": {"type": "constant", "radiance": 0.5}},
    "sphere": lambda: {"lamp": lamp("sphere")},
    "cylinder": lambda: {"lamp": lamp("cylinder")},
    "cube": lambda: {"lamp": lamp("cube"), "sky": sky()},
    "textured rectangle": lambda: {"lamp": lamp("rectangle", zoo.texture(3, low=0, high=20))},
    "point": lambda: {"lamp": {"type": "point", "position": [0.3, 0.5, 2.5], "intensity": rgb(9, 8, 7)}},
    "spot": lambda: {"lamp": {"type": "spot", "to_world": to().look_at([1, -1, 3], [0, 0, 0], [0, 1, 0]), "intensity": rgb(30, 30, 30)}},
    "directional": lambda: {"lamp": {"type": "directional", "direction": [0.3, 0.2, -1], "irradiance": rgb(2, 2, 2)}},
    "sun and sky": lambda: {"sky": {"type": "sunsky", "turbidity": 3.0}},
    "projector": lambda: {
        "lamp": {"type": "projector", "fov": 40, "irradiance": zoo.texture(4), "to_world": to().look_at([1, -1, 3], [0, 0, 0], [0, 1, 0])}
    },
}  # fmt: skip


def with_sensor(sensor: dict[str, Any]) -> Callable[[], dict[str, Any]]:
    """The zoo's scene seen by another sensor."""

    def made() -> dict[str, Any]:
        found = zoo.scene(zoo.rough())
        small = sensor["type"] in ("radiancemeter", "distant")
        film = {**found["sensor"]["film"], **({"width": 1, "height": 1} if small else {})}
        return {**found, "sensor": {"film": film, **sensor}}

    return made


def sensors() -> dict[str, dict[str, Any]]:
    view = to().look_at([0, -4, 2.2], [0, 0, 0.55], [0, 0, 1])
    return {
        "thin lens": {"type": "thinlens", "fov": 35, "to_world": view, "aperture_radius": 0.1, "focus_distance": 4.0},
        "orthographic": {"type": "orthographic", "to_world": view},
        "distant": {"type": "distant", "direction": [0, 0.3, -1]},
        "radiance meter": {"type": "radiancemeter", "origin": [0, -4, 2], "direction": [0, 1, -0.3]},
    }


def more_materials() -> dict[str, dict[str, Any]]:
    """Those that the zoo does not change: smooth, rough at the least roughness, thin, hairy."""
    return {
        "least rough conductor": {"type": "roughconductor", "alpha": 0.02, "distribution": "ggx"},
        "rougher Beckmann": {"type": "roughconductor", "alpha": 1.0, "distribution": "beckmann"},
        "anisotropic conductor": {"type": "roughconductor", "alpha_u": 0.02, "alpha_v": 0.6},
        "least rough glass": {"type": "roughdielectric", "alpha": 0.02},
        "roughest glass": {"type": "roughdielectric", "alpha": 1.0, "int_ior": 2.4},
        "least rough plastic": {"type": "roughplastic", "alpha": 0.02},
        "nonlinear plastic": {"type": "plastic", "nonlinear": True},
        "polished principled": {
            "type": "principled", "roughness": 0.02, "metallic": 1.0, "anisotropic": 1.0, "clearcoat": 1.0, "clearcoat_gloss": 1.0
        },
        "clear principled": {"type": "principled", "roughness": 0.02, "spec_trans": 1.0, "eta": 1.5},
        "velvet": {"type": "principled", "roughness": 1.0, "sheen": 1.0, "sheen_tint": 1.0, "flatness": 0.0},
        "thin principled": {
            "type": "principledthin", "roughness": 0.3, "spec_trans": 0.5, "diff_trans": 0.7, "flatness": 0.5, "sheen": 0.5
        },
        "hair": {"type": "hair", "eumelanin": 0.2, "pheomelanin": 0.4},
    }  # fmt: skip


def subjects() -> dict[str, Callable[[], Any]]:
    """{name: what makes the scene}."""
    found: dict[str, Callable[[], Any]] = {}
    for name, (material, _) in zoo.MATERIALS.items():
        found[f"material: {name}"] = lambda material=material: zoo.scene(material())
    for name, material in more_materials().items():
        found[f"material: {name}"] = lambda material=material: zoo.scene(material)
    for name, emitters in EMITTERS.items():
        found[f"emitter: {name}"] = lambda emitters=emitters: with_emitter(**emitters())()
    for name, sensor in sensors().items():
        found[f"sensor: {name}"] = with_sensor(sensor)
    for name, medium in fog.SCENES.items():
        found[f"medium: {name}"] = medium
    return found


def lost(name: str, what: str, radiance: Any, request: SampleRequest) -> list[str]:
    """One line for each path that is not finite."""
    values = np.array([radiance[channel].numpy() for channel in range(3)])
    bad = np.flatnonzero(~np.isfinite(values).all(axis=0))
    return [
        f"{name}: {what}, seed {request.seed}, {request.spp} spp, pixel {lane // request.spp}, sample {lane % request.spp}: "
        f"{values[:, lane]}"
        for lane in bad.tolist()
    ]


def hunt(name: str, describe: Callable[[], Any], paths: int, replays: bool = False, seed: int = 0) -> Iterator[str]:
    """Trace about `paths` paths of a subject. Yield a line for each non-finite one and, with `replays`, each non-finite gradient."""
    renderer = MitsubaRenderer(describe(), DEPTH)
    height, width = renderer.resolutions()[0]
    spp = max(1, min(LANES, paths) // (height * width))
    launches = max(1, round(paths / (spp * height * width)))
    known = renderer.parameters()
    keys = [key for key, info in known.items() if info.differentiable and info.shares_paths and not info.viewpoint]
    current = renderer.values(keys if replays else [])
    session = renderer.prepare(list(current), "path" if replays else None, derivatives=replays)
    for launch in range(launches):
        request = SampleRequest(0, spp, seed + launch)
        if not replays:
            yield from lost(name, "image", session.image(current, request).paths.radiance, request)
            continue
        previous = {key: value * 0.97 for key, value in current.items()}
        pair = session.image_pair(current, previous, request, "path")
        yield from lost(name, "pair", pair.paths.radiance, request)
        weight = renderer.array(np.ones((1, height, width, 3)))
        for state, tree in zip(
            ("current", "previous"), session.adjoint_pair(current, previous, pair.paths, weight, weight), strict=True
        ):
            for key, gradient in tree.items():
                count = int((~np.isfinite(np.array(gradient))).sum())
                if count:
                    yield f"{name}: {state} gradient of {key}, seed {request.seed}, {spp} spp: {count} elements"


def main() -> int:
    import unrender

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paths", type=float, default=1e6, help="in all, shared by the subjects")
    parser.add_argument("--replays", action="store_true", help="trace pairs and replay them")
    parser.add_argument("--seed", type=int, default=0, help="of the first launch of each subject")
    parser.add_argument("--only", default="", help="subjects whose names contain this")
    options = parser.parse_args()
    unrender.use()
    chosen = {name: make for name, make in subjects().items() if options.only in name}
    total, each = 0, int(options.paths / len(chosen))
    for name, make in chosen.items():
        start, found = time.process_time(), 0
        try:
            for line in hunt(name, make, each, options.replays, options.seed):
                print(line, flush=True)
                found += 1
        except Exception as error:  # a subject that this version of Mitsuba refuses
            print(f"{name}: not traced: {error}", flush=True)
            continue
        total += found
        print(f"{name}: {each} paths, {found} lines, {time.process_time() - start:.0f} s of CPU", flush=True)
    print(f"{total} lines from {each * len(chosen)} paths")
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main())
