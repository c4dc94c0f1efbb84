"""The end of a run: verification and final pictures use kernels that were compiled before the first step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import pytest

import unrender as ur
from tiers import quick
from unrender.protocols import Callback
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
        ur.optimize(made, "auto", steps=3, callbacks=[_History()], run_directory=folder)
        history = dr.kernel_history([dr.KernelType.JIT])
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)
    new = [kernel for kernel in history if not kernel["cache_hit"] or kernel["cache_disk"]]
    return [kernel["operation_count"] for kernel in new if kernel["operation_count"] > _FEW_OPERATIONS]


NAMES = ["stage-lights", "wall"]


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
