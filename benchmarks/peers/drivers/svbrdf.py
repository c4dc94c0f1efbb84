"""Runs the Mitsuba loop of svbrdf_uncertainty (Wiersma et al. 2025), from their checkout, on a scene of ours.

The argument is a JSON file by run.py; their checkout is on PYTHONPATH. Their loop, `opt_mi.optimize_material`, is run as it is, but what it
needs of CUDA stands here for a processor: the type of its target pictures, and empty modules for nvdiffrast and torch_harmonics, which the
loop itself does not call. The clock hangs on the step of `mi.ad.Adam`.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false, reportArgumentType=false
from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from recorder import BudgetSpentError, Recorder, difference, references, task

choose = mi.set_variant
mi.set_variant = lambda *names: choose(*(name for name in names if not name.startswith("cuda")))
mi.set_variant("llvm_ad_rgb")
for name in ("nvdiffrast", "nvdiffrast.torch", "torch_harmonics"):
    sys.modules[name] = types.ModuleType(name)
sys.modules["nvdiffrast"].torch = sys.modules["nvdiffrast.torch"]

import opt_mi  # noqa: E402

_FOREVER = 1_000_000
_CHECK_SPP = 64


def _target(colours: torch.Tensor) -> Any:
    return mi.Color3f(*(mi.Float(np.ascontiguousarray(channel)) for channel in colours.numpy().T))


class Views:
    """What their loop takes as a data set: a scene, its sensors and their pictures, (N, H, W, 3)."""

    hdr = True

    def __init__(self, asked: dict[str, Any]):
        self.scene = mi.load_file(asked["scene"], parallel=False)
        self.sensors = self.scene.sensors()
        self.pictures = references(asked)
        self.frames = torch.from_numpy(np.stack(self.pictures))

    def __len__(self) -> int:
        return len(self.sensors)

    def check(self, depth: int) -> float:
        """How far the rendering of the true scene is from the references."""
        path = mi.load_dict({"type": "prb", "max_depth": depth})
        return difference(
            lambda n, seed: mi.render(self.scene, sensor=self.sensors[n], integrator=path, spp=_CHECK_SPP, seed=seed),
            self.pictures,
        )


def descend(asked: dict[str, Any], seconds: float, steps: int | None) -> tuple[Recorder, float]:
    """One run; what was kept, and how far their rendering of the true scene is from the references."""
    torch.manual_seed(asked["seed"])
    recorder, views = Recorder(seconds, asked["points"], steps), Views(asked)
    check = views.check(asked["depth"]) if asked["check"] and steps is None else 0.0
    adam = mi.ad.Adam

    class Watched(adam):
        def step(self) -> None:
            recorder.step(lambda: {key: np.array(value).astype(np.float32) for key, value in self.variables.items()})
            super().step()

    mi.ad.Adam = Watched
    try:
        opt_mi.optimize_material(
            "peers",
            views,
            asked["keys"],
            experiment_name="peers",
            epoch_count=_FOREVER,
            smoothness_k=0,
            **asked["settings"],
        )
    except BudgetSpentError:
        pass
    finally:
        mi.ad.Adam = adam
    return recorder, check


def main() -> None:
    """Two steps that compile, and the run."""
    asked = task()
    dr.cuda.Array3f = _target
    opt_mi.current_path = Path(asked["folder"])
    sample, shift = opt_mi.sample_rays_multiple_sensors, 1_000_003 * asked["seed"]
    opt_mi.sample_rays_multiple_sensors = lambda *given, seed: sample(*given, seed=seed + shift)
    descend(asked, 1.0, 3)
    recorder, check = descend(asked, asked["seconds"], None)
    recorder.write(Path(asked["out"]), check=check)


main()
