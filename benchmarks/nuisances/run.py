"""What photographs do: drifting exposure, saturated 8-bit pixels and masks two pixels off, with and without a model of each.

A textured ball under a sky, both unknown, seen by eight cameras in pictures made for it. Per fault, at equal steps: the root mean
square error of the base colour after the best factor per channel (only the product of colour and light is seen), of the light's
logarithm likewise, and of the exposures in stops. The clean capture is run with every model, too: what a model costs where there
is no fault.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from scipy import ndimage

import unrender as ur

VIEWS, SIZE, TEXELS = 8, 20, 16
COLOUR, LIGHT, EXPOSURE = "ball.bsdf.reflectance.data", "light.data", "exposure"
FAULTS = {
    "none": (),
    "exposure": ("exposure",),
    "white": ("white",),
    "masks": ("masks",),
    "all": ("exposure", "white", "masks"),
}
DRIFT, WHITE, SHIFT, BAND = 0.3, 0.95, 2, 3
QUICK = {"steps": 10, "seeds": 1}


def scene() -> dict[str, Any]:
    """The ball with its texture and its sky at their true values, and the cameras."""
    rng = np.random.default_rng(0)
    smooth = ndimage.gaussian_filter(rng.uniform(0, 1, (TEXELS, TEXELS, 3)), (1.5, 1.5, 0), mode="wrap")
    texels = np.interp(smooth, (smooth.min(), smooth.max()), (0.2, 0.8)).astype(np.float32)
    sky = (0.5 + ndimage.gaussian_filter(rng.exponential(1.0, (8, 16, 3)), (1, 1, 0), mode="wrap")).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "format": "variant"}
    found: dict[str, Any] = {
        "type": "scene",
        "ball": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": texture}},
        "light": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
    }
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    for index in range(VIEWS):
        angle, height = 2 * np.pi * index / VIEWS, 2.5 * np.sin(1 + 2.3 * index)
        place = mi.ScalarTransform4f().look_at([4 * np.cos(angle), 4 * np.sin(angle), height], [0, 0, 0], [0, 0, 1])
        found[f"camera{index}"] = {"type": "perspective", "fov": 32, "to_world": place, "film": dict(film)}
    return found


def photographs(
    base: ur.Problem, faults: tuple[str, ...], models: tuple[str, ...]
) -> tuple[list[ur.View], np.ndarray, float]:
    """Views with these faults, and masks as these models take them; the true exposures, and white."""
    rng = np.random.default_rng(1)
    drift = rng.normal(0, DRIFT, (VIEWS, 3)) * ("exposure" in faults)
    drift -= drift.mean(0)
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    inside = np.hypot(x, y) < 0.9 * SIZE / 2
    # The camera's white: a tenth of the pixels is saturated.
    level = np.percentile([np.asarray(view.reference)[inside] for view in base.views], 90)
    views = []
    for index, view in enumerate(base.views):
        picture = np.asarray(view.reference) * 2.0 ** drift[index]
        mask = inside
        if "white" in faults:
            picture = np.clip(picture / level, 0, 1)
            encoded = np.where(picture <= 0.0031308, 12.92 * picture, 1.055 * picture ** (1 / 2.4) - 0.055)
            shown = np.round(255 * encoded) / 255
            picture = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4) * level
        if "masks" in faults:
            # The photograph shows a dark wall where the scene has its sky, and the mask is off by two pixels.
            picture = np.where((np.hypot(x, y) < SIZE / 2 * 0.95)[..., None], picture, 0.05)
            mask = np.roll(inside, (SHIFT, -SHIFT), (0, 1))
        weights = mask.astype(np.float32)
        if "masks" in models:
            weights = np.where(np.asarray(ndimage.distance_transform_edt(mask)) > BAND, weights, 0.1 * weights)
        views.append(ur.View(picture.astype(np.float32), index, mask=weights))
    return views, drift, float(level)


def errors(found: dict[str, np.ndarray], truth: dict[str, np.ndarray], drift: np.ndarray) -> dict[str, float]:
    """Of colour, light and exposures."""
    colour, true = (x[COLOUR].reshape(-1, 3) for x in (found, truth))
    scale = (colour * true).sum(0) / np.square(colour).sum(0)
    light = np.log(np.maximum(found[LIGHT], 1e-6)) - np.log(truth[LIGHT])
    light = (light - light.mean((0, 1)))[1:-1, 1:-1]
    result = {
        "colour": float(np.sqrt(np.mean((scale * colour - true) ** 2))),
        "light": float(np.sqrt(np.mean(light**2))),
    }
    if EXPOSURE in found:
        result["exposure"] = float(np.sqrt(np.mean((found[EXPOSURE] - found[EXPOSURE].mean(0) - drift) ** 2)))
    return result


def run(fault: tuple[str, ...] = tuple(FAULTS), steps: int = 150, seeds: int = 2) -> dict[str, Any]:
    """Every fault, without and with its models."""
    made = ur.Problem(scene, [ur.Parameter(COLOUR), ur.Parameter(LIGHT)], [
        ur.View(np.ones((SIZE, SIZE, 3)), index) for index in range(VIEWS)
    ], max_depth=2)  # fmt: skip
    truth = made.initial_values()
    exact = [ur.render(made, view=index, spp=1024) for index in range(VIEWS)]
    base = ur.Problem(made.renderer, made.parameters, [ur.View(x, i) for i, x in enumerate(exact)], max_depth=2)
    starts = [ur.Parameter(COLOUR, 0.4), ur.Parameter(LIGHT, 1.0)]
    found: dict[str, Any] = {}
    for name in fault:
        every = FAULTS["all"] if name == "none" else FAULTS[name]
        for models in ((), every):
            views, drift, level = photographs(base, FAULTS[name], models)
            loss = ur.losses.Censored(ur.losses.L1(), WHITE * level) if "white" in models else ur.losses.L1()
            parameters = [*starts, *([ur.Parameter(EXPOSURE)] if "exposure" in models else [])]
            problem = ur.Problem(made.renderer, parameters, views, loss, max_depth=2)
            rows = [
                errors(ur.optimize(problem, "auto", steps=steps, seed=seed).parameters, truth, drift)
                for seed in range(seeds)
            ]
            entry = {key: [row[key] for row in rows] for key in rows[0]}
            found.setdefault(name, {})["with" if models else "without"] = entry
            print(name, models, entry, flush=True)
    return {"faults": found, "steps": steps}
