"""Images and gradients as a loop of Mitsuba's own functions has them: `mi.render` with path replay, and `dr.backward`."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.core.trees import Tree
from unrender.rendering.mitsuba.light_paths import LightPaths
from unrender.rendering.mitsuba.loaded_scene import LoadedScene
from unrender.rendering.mitsuba.scene_loading import SceneDescription
from unrender.rendering.renderer import LossWeights

__all__ = ["StockSession"]


class StockSession:
    """A load of the scene for `mi.render` alone: its own film, with the reconstruction filter that the scene gives it.

    Args:
        description: what to load.
        moving: ids of shapes that move; the spheres among them become meshes.
        volumetric: whether there is a participating medium, which takes `prbvolpath` in place of `prb`.
        paths: settings of the light paths.
    """

    def __init__(self, description: SceneDescription, moving: AbstractSet[str], volumetric: bool, paths: LightPaths):
        self._loaded = LoadedScene(description, moving)
        kind = "prbvolpath" if volumetric else "prb"
        self._integrator: Any = mi.load_dict(
            {
                "type": kind,
                "max_depth": paths.max_depth,
                "rr_depth": paths.rr_depth,
                "hide_emitters": paths.hide_emitters,
            }
        )

    def gradient(
        self, parameters: Tree, sensor: int, spp: int, seeds: tuple[int, int], weigh: LossWeights
    ) -> tuple[mi.TensorXf, Tree]:
        """See `StockLoop.gradient`."""
        scene = self._loaded
        scene.detach()  # of leaves that were differentiated before, the derivative graph is gone
        scene.set_parameters(parameters, parameters.keys())
        image = mi.render(
            scene.scene,
            scene.parameters,
            sensor=sensor,
            integrator=self._integrator,
            spp=spp,
            seed=mi.UInt32(seeds[0]),
            seed_grad=mi.UInt32(seeds[1]),  # pyright: ignore[reportArgumentType]
        )
        channels = image.shape[2]
        if channels in (2, 4):  # a film with alpha, which references have not
            image = image[:, :, : channels - 1]
        if channels <= 2:  # of luminance, in all three channels
            image = image * dr.ones(mi.TensorXf, (1, 1, 3))
        seen = mi.TensorXf(dr.detach(image))
        dr.backward(dr.sum(image * weigh(seen), axis=None))
        gradient = scene.take_gradients()
        dr.eval(seen)
        return seen, gradient
