"""The probabilities with which connections take emitters, by the variance of the gradient."""

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
"""Probabilities as the scene has them, uniform but for its sampling weights; or by the variance of the gradient."""

_FIRST, _REFRESH = 4, 20
"""Steps at the beginning that are all learnt from, and steps between those that are, later."""

_MEMORY = 0.8
"""Weight, each time, of what was learnt before."""

_LEAST_VARIANCE = 0.1
"""Floor of a pixel's variance where one divides by it, relative to the mean over all pixels."""


@dataclass(frozen=True)
class EmitterRequest:
    """What a step is asked for.

    Attributes:
        probabilities: of each emitter, (E,), sum 1.
        tangents: of the parameters, along which `connections` are asked for; {} where they are not.
    """

    probabilities: np.ndarray
    tangents: Tree


@dataclass(frozen=True)
class EmitterState:
    """State between steps.

    The probabilities of the E emitters are p = λ u + (1 - λ) q with q ∝ √M, for u, the scene's own, and the second moment M of what
    connections to each emitter add. Of connections that are drawn by p, the second moment of the gradient is Σ_e M_e / p_e plus what no
    probability changes, and that q minimises it. Since p >= λ u, each of the two factors of a gradient, the loss derivative and the
    pixel's, has at most 1 / λ times the second moment that it has under u. Where paths sampled by the BSDF find an emitter, too, MIS
    weights change with p, which M leaves out: then q is near the best, and the bound holds approximately.

    Attributes:
        start: u, (E,).
        step: estimates made so far.
        moments: M / u, running mean up to a factor, (E,); zeros before the first is known.
        uniform: λ.
        evidence: for λ, see `uniform_share`.
        second_moment: running mean square of each element of the gradient, in the coordinates of the descent.
    """

    start: np.ndarray
    step: int
    moments: np.ndarray
    uniform: float = uniform_share.MOST
    evidence: ShareEvidence = field(default_factory=ShareEvidence)
    second_moment: Tree = field(default_factory=dict)

    def upsampled(self, upsampler: Upsampler) -> EmitterState:
        """See `Upsamplable`: the mean squares of the gradient are interpolated."""
        return replace(self, second_moment=upsampler.tree(self.second_moment, SQUARES))

    @property
    def known(self) -> bool:
        """Whether anything was learnt."""
        return bool(self.moments.sum() > 0)

    @property
    def density(self) -> np.ndarray:
        """q / u, (E,); ones before anything is known, and where u is 0."""
        if not self.known:
            return np.ones(len(self.start))
        root = np.sqrt(self.moments * self.start)
        taken = self.start > 0
        return np.divide(root / root.sum(), self.start, out=np.ones(len(root)), where=taken)

    @property
    def probabilities(self) -> np.ndarray:
        """p, (E,)."""
        found = self.start * (self.uniform + (1 - self.uniform) * self.density)
        return found / found.sum()


def init(owner: str, problem: Problem, session: RenderSession) -> EmitterState | None:
    """The state before the first step; None where the scene has one emitter at most, and there is nothing to choose.

    Raises `InputError` where the renderer takes no probabilities of emitters.
    """
    try:
        start = drawing_emitters(session).emitters()
    except InputError as error:
        raise InputError(f'{owner}: emitters="adaptive": {error}; leave emitters="scene"') from error
    return EmitterState(start, 0, np.zeros(len(start))) if (start > 0).sum() > 1 else None


def request(problem: Problem, parameters: Tree, state: EmitterState, key: Key) -> EmitterRequest:
    """What the next step is asked for; with random ±1 tangents where it is to be learnt from."""
    tangents: Tree = {}
    if state.step < _FIRST or state.step % _REFRESH == 0:
        scales = pixel_statistics.scales(parameters, state.second_moment)
        tangents = pixel_statistics.random_tangents(problem, parameters, scales, key)
    return EmitterRequest(state.probabilities, tangents)


def connections(
    session: RenderSession, parameters: Tree, tangents: Tree, found: ImageEstimate, weights: Array, spp: int
) -> EmitterMoments:
    """What the connections of a frame tell: Σ y by emitter, with Σ_e M_e / p_e = E[Σ y] for the probabilities p that they were drawn with.

    A connection that adds f to its pixel j changes the gradient by ∂L/∂I_j · ∂f/∂θ, and by its noise in ∂L/∂I_j, times the derivative of
    the pixel's other samples. With B_j = Σ_k E[(∂I_j/∂θ_k)²] and h_j, the derivative of ∂L/∂I_j by I_j,

        y = (∂L/∂I_j Σ_k v_k ∂f/∂θ_k)² / S² + h_j² B_j f² / (S² n),

    for S samples of the pixel, of which n make the image of the other groups: what f² changes in the product of both factors' second
    moments. B_j is of the other groups, as the loss derivative is: with the connection's own, bright paths would count by their fourth
    power. h_j² is the variance over groups of the loss derivative over that of the image, so that a control variate counts.

    Args:
        session: of the frame's paths.
        parameters: of these.
        tangents: random.
        found: the image, of two groups or more.
        weights: of the adjoint, the loss derivative at the image of the other groups, (groups, ...).
        spp: S.
    """
    images = found.fresh_others()
    groups = int(arrays.shape(images)[0])
    moments = session.tangent_moment(parameters, found.paths, tangents)
    variance = _variance(images)
    floor = arrays.mean(variance) * _LEAST_VARIANCE + 1e-30
    slope = _variance(weights) / arrays.maximum(variance, floor)
    noise = arrays.sqrt(leave_one_out(moments) * slope * (groups / (spp * (groups - 1.0))))
    return drawing_emitters(session).emitter_moments(parameters, found.paths, tangents, weights, noise)


def _variance(images: Array) -> Array:
    mean = arrays.mean_over_first(images)
    return arrays.maximum(arrays.mean_over_first(images * images) - mean * mean, 0.0)


def learned(state: EmitterState, told: EmitterMoments | None) -> EmitterState:
    """The state after a step, with what its connections tell; None where they were not asked for."""
    state = replace(state, step=state.step + 1)
    if told is None:
        return state
    # A sample's second moment under u: it was drawn by p.
    ratio = np.divide(state.probabilities, state.start, out=np.zeros(len(state.start)), where=state.start > 0)
    y, squares = told.sums * ratio, told.squares * ratio**2
    total = float(y.sum())
    if not (np.isfinite(squares).all() and total > 0):
        return state
    y, squares = y / total, squares / total**2  # steps count alike, whatever the loss has become in between
    evidence, uniform = state.evidence, state.uniform
    if state.known:
        evidence = _observed(evidence, y, squares, state.density)
        uniform = uniform_share.choose(evidence)
    return replace(state, moments=state.moments * _MEMORY + y, evidence=evidence, uniform=uniform)


def _observed(evidence: ShareEvidence, y: np.ndarray, squares: np.ndarray, density: np.ndarray) -> ShareEvidence:
    """`uniform_share.observed`, from sums over each emitter's samples. Both rows are the same."""
    mixed = SHARES[:, None] + (1 - SHARES[:, None]) * density
    moments = np.append((y / mixed).sum(axis=1), y.sum())
    return ShareEvidence(evidence.moments * _MEMORY + moments, evidence.squares * _MEMORY + squares.sum())


def observed(problem: Problem, state: EmitterState, gradient: Tree) -> EmitterState:
    """The state after a step with this gradient by u (`Problem.coordinates`), before preconditioning: variances count relative to the mean
    squares, as in Adam's steps."""
    return replace(state, second_moment=pixel_statistics.observed(problem, state.second_moment, gradient))


def check(owner: str, emitters: Any, groups: int, equal_counts: bool) -> None:
    """Raise `InputError` for what is no way to choose emitters, or does not go with the samples.

    Args:
        owner: for messages.
        emitters: the option.
        groups: leave-one-out groups.
        equal_counts: whether all pixels have as many samples.
    """
    if emitters not in ("scene", "adaptive"):
        raise InputError(f'{owner}: emitters must be "scene" or "adaptive", got {emitters!r}')
    if emitters == "adaptive" and not equal_counts:
        raise InputError(f'{owner}: emitters="adaptive" needs as many samples in each pixel; AdaptiveCounts differs')
    if emitters == "adaptive" and groups < 2:
        raise InputError(
            f'{owner}: emitters="adaptive" compares groups of samples: give an spp that 2 to 16 divide, and no adjoint_spp'
        )
