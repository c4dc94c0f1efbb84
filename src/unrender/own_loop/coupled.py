"""The product of the image's Jacobian with a given loss derivative, with that of the last step as its control variate."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from unrender.core import arrays, trees
from unrender.core.arrays import Array
from unrender.core.trees import Tree
from unrender.rendering.renderer import RenderSession, SampleRequest, Space
from unrender.statistics import meta

__all__ = ["CoupledGradient", "CoupledState", "coupled_gradient"]


@dataclass(frozen=True)
class CoupledState:
    """State between steps.

    Attributes:
        parameters: of the last step that had a gradient; None before the first.
        derivative: the loss derivative of that step, (1, H, W, 3).
        elements: {key: meta-estimate and statistics of each element of the gradient}; empty before the first step.
    """

    parameters: Tree | None = None
    derivative: Array | None = None
    elements: dict[str, meta.State] = field(default_factory=dict)


@dataclass(frozen=True)
class CoupledGradient:
    """What a coupled step gives.

    Attributes:
        gradient: {key: array}.
        variance: of `gradient` per element, as the recurrence has it.
        state: the next.
    """

    gradient: Tree
    variance: Tree
    state: CoupledState


def coupled_gradient(
    session: RenderSession,
    space: Space,
    parameters: Tree,
    request: SampleRequest,
    derivative: Array,
    state: CoupledState,
) -> CoupledGradient:
    """M_n = F_n + w (M_{n−1} − H_n), with F_n = J(θ_n)ᵀ g_n and H_n = J(θ_{n−1})ᵀ g_{n−1} from the same paths.

    The loss lives outside, so its derivatives g_n are given: H_n takes the one that the user gave at the last step. Given these, the
    recursion reduces the noise of the paths of J, and leaves that of g_n to the image that the loss sees. Of `MetaEstimator(coupled=True)`
    this is the recursion, per element, with w from the covariance of F and H. Differences are not divided by the step length
    (Eq. 13), since g_n − g_{n−1} need not vanish with it.

    Bias: that of MetaEstimator with shared statistics: w knows the samples that it weighs, which pulls the gradient toward zero, most
    at the first steps.

    Args:
        session: of both states.
        space: in which they share samples.
        parameters: the current ones.
        request: the samples of the adjoint, independent of those of the image; of one group.
        derivative: g_n, (1, H, W, 3).
        state: the last.
    """
    previous, before, elements = state.parameters, state.derivative, state.elements
    if previous is None or before is None or trees.shapes(previous) != trees.shapes(parameters):
        previous, before, elements = parameters, derivative, {key: meta.init(x) for key, x in parameters.items()}
    rendering = session.image_pair(parameters, previous, replace(request, both_gradients=True), space)
    F, H = session.adjoint_pair(parameters, previous, rendering.paths, derivative, before)
    found = {key: meta.update_coupled(elements[key], F[key], H[key], 1.0, decouple=False) for key in parameters}
    gradient, variance, _, after = ({key: parts[n] for key, parts in found.items()} for n in range(4))
    arrays.evaluate(gradient, variance, after)
    return CoupledGradient(gradient, variance, CoupledState(parameters, derivative, after))
