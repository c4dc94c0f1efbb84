"""Probabilities of emitter sampling that minimise the variance of the gradient."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.random import Key
from unrender.core.trees import Tree
from unrender.images.base import ImageEstimate, leave_one_out
from unrender.pixels import pixel_statistics, uniform_share
from unrender.pixels.uniform_share import SHARES, ShareEvidence
from unrender.rendering.renderer import EmitterMoments, RenderSession, drawing_emitters
from unrender.scene.problem import Problem
from unrender.scene.upsampling import SQUARES, Upsampler

EmitterSelection = Literal["scene", "adaptive"]
"""Emitter probabilities: "scene" for uniform times the scene's sampling weights, "adaptive" to minimise the gradient's variance."""

_FIRST, _REFRESH = 4, 20
"""Number of initial steps that all update the probabilities, and interval of later updates in steps."""

_MEMORY = 0.8  # decay of earlier statistics at each update
_LEAST_VARIANCE = 0.1  # floor of a pixel's variance in divisions, relative to the mean over all pixels


@dataclass(frozen=True)
class EmitterRequest:
    """Emitter sampling of a step: probability of each emitter, (E,), sum 1, and tangents for `connections`, {} without an update."""

    probabilities: np.ndarray
    tangents: Tree


@dataclass(frozen=True)
class EmitterState:
    """State between steps.

    The probabilities of the E emitters are p = λ u + (1 - λ) q with q ∝ √M. Here u are the scene's own probabilities and M is the
    second moment of the contributions of connections to each emitter. With connections sampled by p, the second moment of the gradient
    is Σ_e M_e / p_e plus a constant, which this q minimises. Since p >= λ u, the second moment of each factor of a gradient, the loss
    derivative and the pixel's, is at most 1 / λ times that under u. If BSDF sampling hits an emitter too, MIS weights change with p. M
    neglects this, so q is approximately optimal and the bound approximate.

    Attributes:
        start: u, (E,).
        step: number of estimates so far.
        moments: M / u, running mean up to a factor, (E,); zeros before the first update.
        uniform: λ.
        evidence: statistics for λ, see `uniform_share`.
        second_moment: running mean square of each element of the gradient with respect to v (`scene.coordinates`).
    """

    start: np.ndarray
    step: int
    moments: np.ndarray
    uniform: float = uniform_share.MOST
    evidence: ShareEvidence = field(default_factory=ShareEvidence)
    second_moment: Tree = field(default_factory=dict)

    def upsampled(self, upsampler: Upsampler) -> EmitterState:
        return replace(self, second_moment=upsampler.tree(self.second_moment, SQUARES))

    @property
    def known(self) -> bool:
        """True if the probabilities were updated at least once."""
        return bool(self.moments.sum() > 0)

    @property
    def density(self) -> np.ndarray:
        """q / u, (E,); ones before the first update, and where u is 0."""
        if not self.known:
            return np.ones(len(self.start))
        root = np.sqrt(self.moments * self.start)
        positive = self.start > 0
        return np.divide(root / root.sum(), self.start, out=np.ones(len(root)), where=positive)

    @property
    def probabilities(self) -> np.ndarray:
        """p, (E,)."""
        mixture = self.start * (self.uniform + (1 - self.uniform) * self.density)
        return mixture / mixture.sum()


def init(owner: str, session: RenderSession) -> EmitterState | None:
    """Return the first state; None for at most one emitter. Raises `InputError` without support for custom emitter sampling."""
    try:
        start = drawing_emitters(session).emitters()
    except InputError as error:
        raise InputError(f'{owner}: emitters="adaptive": {error}; leave emitters="scene"') from error
    return EmitterState(start, 0, np.zeros(len(start))) if (start > 0).sum() > 1 else None


def request(problem: Problem, parameters: Tree, state: EmitterState, key: Key) -> EmitterRequest:
    """Return the emitter sampling of the next step, with random ±1 tangents if the step updates the probabilities."""
    tangents: Tree = {}
    if state.step < _FIRST or state.step % _REFRESH == 0:
        scales = pixel_statistics.scales(parameters, state.second_moment)
        tangents = pixel_statistics.random_tangents(problem, parameters, scales, key)
    return EmitterRequest(state.probabilities, tangents)


def connections(
    session: RenderSession, parameters: Tree, tangents: Tree, image: ImageEstimate, weights: Array, spp: int
) -> EmitterMoments:
    """Return the connection statistics of a frame: Σ y by emitter, with Σ_e M_e / p_e = E[Σ y] for the sampling probabilities p.

    A connection that adds f to its pixel j changes the gradient by ∂L/∂I_j · ∂f/∂θ, and by its noise in ∂L/∂I_j times the derivative of
    the pixel's other samples. With B_j = Σ_k E[(∂I_j/∂θ_k)²] and h_j = ∂²L/∂I_j²,

        y = (∂L/∂I_j Σ_k v_k ∂f/∂θ_k)² / S² + h_j² B_j f² / (S² n),

    for S samples of the pixel, of which n form the image of the other groups. The second term is the effect of f² on the product of
    both factors' second moments. B_j comes from the other groups, like the loss derivative: with the connection's own, bright paths
    would count by their fourth power. h_j² is the variance over groups of the loss derivative over that of the image, which accounts
    for a control variate.

    Args:
        session: session of the frame's paths.
        image: image of at least two groups.
        weights: weights of the adjoint, the loss derivative at the image of the other groups, (groups, ...).
        spp: S.
    """
    images = image.fresh_others()
    groups = int(arrays.shape(images)[0])
    moments = session.tangent_moment(parameters, image.paths, tangents)
    variance = _variance(images)
    floor = arrays.mean(variance) * _LEAST_VARIANCE + 1e-30
    slope = _variance(weights) / arrays.maximum(variance, floor)
    noise = arrays.sqrt(leave_one_out(moments) * slope * (groups / (spp * (groups - 1.0))))
    return drawing_emitters(session).emitter_moments(parameters, image.paths, tangents, weights, noise)


def _variance(images: Array) -> Array:
    mean = arrays.mean_over_first(images)
    return arrays.maximum(arrays.mean_over_first(images * images) - mean * mean, 0.0)


def learned(state: EmitterState, statistics: EmitterMoments | None) -> EmitterState:
    """Return the state after a step, updated by its connection statistics; None if they were not requested."""
    state = replace(state, step=state.step + 1)
    if statistics is None:
        return state
    # Convert the second moment of samples from p to u.
    ratio = np.divide(state.probabilities, state.start, out=np.zeros(len(state.start)), where=state.start > 0)
    y, squares = statistics.sums * ratio, statistics.squares * ratio**2
    total = float(y.sum())
    if not (np.isfinite(squares).all() and total > 0):
        return state
    y, squares = y / total, squares / total**2  # normalise, so that all steps have equal weight as the loss decreases
    evidence, uniform = state.evidence, state.uniform
    if state.known:
        evidence = _observed(evidence, y, squares, state.density)
        uniform = uniform_share.choose(evidence)
    return replace(state, moments=state.moments * _MEMORY + y, evidence=evidence, uniform=uniform)


def _observed(evidence: ShareEvidence, y: np.ndarray, squares: np.ndarray, density: np.ndarray) -> ShareEvidence:
    """Return `uniform_share.observed` of sums over each emitter's samples. Both rows are the same."""
    mixed = SHARES[:, None] + (1 - SHARES[:, None]) * density
    moments = np.append((y / mixed).sum(axis=1), y.sum())
    return ShareEvidence(evidence.moments * _MEMORY + moments, evidence.squares * _MEMORY + squares.sum())


def observed(problem: Problem, state: EmitterState, gradient: Tree) -> EmitterState:
    """Return the state after a gradient with respect to u, before preconditioning. Variances are relative to its mean squares, as in
    Adam."""
    return replace(state, second_moment=pixel_statistics.observed(problem, state.second_moment, gradient))


def check(owner: str, emitters: Any, groups: int, equal_counts: bool) -> None:
    """Raise `InputError` for a choice of emitters that the leave-one-out groups, or pixels of unequal sample counts, do not support."""
    if emitters == "adaptive" and not equal_counts:
        raise InputError(
            f'{owner}: emitters="adaptive" needs equal sample counts in all pixels; use another pixel sampler than AdaptiveCounts'
        )
    if emitters == "adaptive" and groups < 2:
        raise InputError(
            f'{owner}: emitters="adaptive" needs sample groups; use an spp that is divisible by a number from 2 to 16, and no adjoint_spp'
        )
