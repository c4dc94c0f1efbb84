# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Mitsuba's own path replay, for parameters that move geometry."""

from __future__ import annotations

from typing import Any

import mitsuba as mi


class PrbKernel:
    """Mitsuba's `prb` behind the interface of `PathPair`, for parameters that move geometry: its adjoint carries the
    continuous part of their derivative. Visibility is left out, so those gradients are biased."""

    def __init__(self, max_depth: int):
        self._integrator = mi.load_dict({"type": "prb", "max_depth": max_depth})

    def sample(
        self, mode, scene, tables, sampler, ray, δL=None, state_in=None, pair=False, δLₚ=None, stateₚ_in=None
    ) -> tuple[Any, Any]:
        """See `PathPair.sample`; never a pair."""
        del tables, pair, δLₚ, stateₚ_in
        active = mi.Bool(True)
        L = self._integrator.sample(mode, scene, sampler, ray, δL, state_in, active)[0]
        return L, None
