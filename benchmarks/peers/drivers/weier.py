"""Runs the pipeline of Weier et al. 2025, from their checkout, on a scene of ours: their scene loader, variables, integrator and loop.

The argument is a JSON file by run.py; their `python` folder is on PYTHONPATH. Of theirs nothing is changed: the clock hangs on their
`MitsubaVariables.update`, which follows each step, and seeds of `mi.render` are shifted, since their loop counts them from 1.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false, reportArgumentType=false
from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from recorder import BudgetSpentError, Recorder, difference, references, task

mi.set_variant("llvm_ad_rgb")

import core.bsdfs  # noqa: E402
import core.integrators  # noqa: E402
import core.textures  # noqa: E402
from core import mipmap_util  # noqa: E402
from practical_reconstruction import optimization, scene_preparation  # noqa: E402
from practical_reconstruction.scene_configuration import Approach, SceneConfig  # noqa: E402
from variables import parameters as parameters_lib  # noqa: E402

for plugins in (core.bsdfs, core.integrators, core.textures):
    plugins.register()
mi.set_variant("scalar_rgb")
mi.set_variant("llvm_ad_rgb")

_FOREVER = 1_000_000
_CHECK_SPP = 64


def textures(params: Any, keys: list[str]) -> dict[str, np.ndarray]:
    """The finest level of each texture, (H, W, C), by its key without their suffix."""
    found = {}
    for key in keys:
        name = key.removesuffix(".flat_buffer")
        if name == key:
            value = np.array(params[key])
        else:
            parts = (
                params[f"{name}.{part}"]
                for part in ("flat_buffer", "flat_buffer_offsets", "base_mip_shape", "mip_factor")
            )
            value = np.array(mipmap_util.mip_tensor_from_flat_buffer(0, *parts))
        found[name] = value.astype(np.float32)
    return found


def descend(asked: dict[str, Any], seconds: float, steps: int | None) -> tuple[Recorder, float]:
    """One run; what was kept, and how far their rendering of the true scene is from the references."""
    settings = dict(asked["settings"])
    folder = Path(asked["folder"])
    config = SceneConfig(
        approach=Approach[settings.pop("approach")],
        scene_name="peers",
        result_folder=str(folder / "results"),
        tmp_folder=str(folder / "tmp"),
        optimized_path_depth=asked["depth"],
        n_iter=_FOREVER,
        output_iterations=[],
        mip_bias=-1.0,
        per_material_learning_rates={asked["material"]: settings.pop("shares")},
        **settings,
    )
    scene = scene_preparation.load_mitsuba_scene(config, asked["scene"])
    params = mi.traverse(scene)
    sensors, pictures = scene.sensors(), references(asked)
    integrator = mi.load_dict({"type": "prb_raydiff", "max_depth": asked["depth"]})
    check = 0.0
    if asked["check"] and steps is None:
        check = difference(
            lambda n, seed: mi.render(scene, sensor=sensors[n], integrator=integrator, spp=_CHECK_SPP, seed=seed),
            pictures,
        )
    keys = scene_preparation.get_scene_keys_for_optimization(scene, config)
    scene_preparation.initialize_optimized_parameter(config, params, keys)
    variables = scene_preparation.create_variables(params, keys, config)
    recorder = Recorder(seconds, asked["points"], steps)

    class Watched(parameters_lib.MitsubaVariables):
        def update(self, state: Any, iteration: int) -> None:
            super().update(state, iteration)
            recorder.step(lambda: textures(params, keys))

    parameters_lib_kept, parameters_lib.MitsubaVariables = parameters_lib.MitsubaVariables, Watched
    try:
        optimization.optimize(
            config,
            scene,
            [sensors],
            [[[mi.TensorXf(picture)] for picture in pictures]],
            scene_preparation.get_emitter_keys(config, params),
            integrator,
            params,
            variables,
        )
    except BudgetSpentError:
        pass
    finally:
        parameters_lib.MitsubaVariables = parameters_lib_kept
    return recorder, check


def main() -> None:
    """Two steps that compile, and the run."""
    asked = task()
    render, shift = mi.render, 1_000_003 * asked["seed"]
    mi.render = lambda *given, seed=0, **options: render(*given, seed=seed + shift, **options)
    descend(asked, 1.0, 2)
    recorder, check = descend(asked, asked["seconds"], None)
    recorder.write(Path(asked["out"]), check=check)


main()
