"""Coarse to fine: parameters that take steps to finer resolutions while the run goes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from unrender.runs import multiresolution
from unrender.runs.hooks import Hook

if TYPE_CHECKING:
    from unrender.runs.loop import Descent

__all__ = ["Refinement"]


class Refinement(Hook):
    """Refines parameters and states before the steps at which their resolution changes, and records the resolutions.

    Compiling the kernels of the new resolution counts as warm-up.
    """

    def __init__(self) -> None:
        self._refined = False

    def before_step(self, descent: Descent) -> None:
        """See `Hook.before_step`."""
        multiresolution.hurry(descent.run)
        self._refined = multiresolution.is_due(descent.run)
        if self._refined:
            descent.log.warmup_seconds += multiresolution.refine(descent.run, descent.state) + descent.warm_up()[0]

    def on_step(self, descent: Descent, record: dict[str, Any]) -> None:
        """See `Hook.on_step`."""
        run = descent.run
        keys = run.problem.coarse_to_fine
        if self._refined or (run.step == 1 and keys):
            record["resolution"] = {key: run.parameters[key].shape[:-1] for key in keys}

    def warnings(self, descent: Descent) -> list[str]:
        """See `Hook.warnings`: parameters that did not come to their scene's own resolution."""
        return multiresolution.unfinished(descent.run) if descent.run.stopped else []
