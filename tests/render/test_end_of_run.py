"""The end of a run: verification and final pictures use kernels that were compiled before the first step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from tiers import quick
from unrender.estimators.fresh_pictures import FreshPictures
from unrender.protocols import Callback
from unrender.runs import verify
from unrender.runs.folder.writer import RunWriter
from unrender.runs.verify import Verify

_FEW_OPERATIONS = 200
"""Operations of a kernel that does no more than arithmetic of arrays."""


class _History(Callback):
    """Starts the history of kernels after the last step."""

    def on_step(self, run: Any, record: dict[str, Any]) -> None:
        del record
        if run.step == run.steps:
            dr.set_flag(dr.JitFlag.KernelHistory, True)
            dr.kernel_history_clear()


def _compiled(folder: Path, name: str) -> list[int]:
    """Return the numbers of operations of the kernels that a run compiles, or loads from the disk, after its last step."""
    dr.flush_kernel_cache()
    made = ur.gallery.problem(name, resolution=16, reference_spp=16)
    try:
        ur.optimize(made, "auto", steps=STEPS[name], callbacks=[_History()], run_directory=folder)
        history = dr.kernel_history([dr.KernelType.JIT])
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    new = [kernel for kernel in history if not kernel["cache_hit"] or kernel["cache_disk"]]
    return [kernel["operation_count"] for kernel in new if kernel["operation_count"] > _FEW_OPERATIONS]


STEPS = {"stage-lights": 24, "wall": 3}
"""Steps of a run whose end has time for its tests."""
NAMES = list(STEPS)


@pytest.mark.parametrize("name", quick(NAMES, "wall"))
def test_nothing_compiles_after_the_last_step(name: str, tmp_path: Path) -> None:
    assert not _compiled(tmp_path / "run", name)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_without_a_warm_up_kernels_compile_after_the_last_step(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The planted fault of the test above."""
    for hook in (RunWriter, Verify):
        monkeypatch.setattr(hook, "on_warm_up", lambda *_: None)
    assert _compiled(tmp_path / "late", name)


def _camera(angle: float) -> dict[str, Any]:
    origin = [4.0 * np.sin(angle), 1.5, 4.0 * np.cos(angle)]
    film = {"type": "hdrfilm", "width": 48, "height": 40, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0])
    return {"type": "perspective", "fov": 40, "to_world": to_world, "film": film}


@pytest.mark.parametrize("key", quick(["cube.translation", "second.translation"], "cube.translation"))
def test_a_pose_that_several_views_show_is_verified(key: str) -> None:
    """Samples of pixels show moving shapes and cameras, too: a sample of one view has no standard error."""
    scene = {
        "type": "scene",
        **{name: _camera(angle) for name, angle in (("first", 0.0), ("second", 1.0), ("third", 2.5))},
        "cube": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.6)},
        "sky": {"type": "constant"},
    }
    parameters = [ur.Parameter(key, initial=[0.0, 0.0, 0.0])]
    made = ur.Problem(scene, parameters, [ur.View(np.zeros((40, 48, 3)), view) for view in range(3)])
    views = [ur.View(ur.render(made, view=view, spp=64), view) for view in range(3)]
    made = ur.Problem(scene, parameters, views)
    pictures = FreshPictures(made, 0, 0)
    assert pictures.sampled
    truth, moved = (pictures.picture({key: np.array([x, 0.0, 0.0])}) for x in (0.0, 0.8))
    assert verify._is_worse(pictures, truth, moved)
    assert not verify._is_worse(pictures, moved, truth)
    assert not verify._is_worse(pictures, truth, truth)
