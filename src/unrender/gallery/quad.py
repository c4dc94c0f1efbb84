"""Problem `quad`: the smooth quadratic of Wang et al., section 4, without a renderer."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields
from unrender.losses import L2, Loss
from unrender.rendering.numpy.one_pixel import POINT, QuadraticRenderer
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.view import View

_MATRIX = np.array([[5.0, 3.75], [3.75, 5.0]])
_START = (1.5, 1.0)


@register(name="quad", position=14)
@dataclass(frozen=True)
class Quad:
    """The minimum of 5 x₀² + 5 x₁² + 7.5 x₀ x₁, a narrow smooth valley: no renderer, no noise.

    Two unknowns, x (2,). The minimum is 0 at 0, the start is (1.5, 1). With L2, the default, the loss is the polynomial itself. Its
    Hessian has eigenvalues 17.5 and 2.5, along (1, 1) and (1, −1). At this ratio of seven, steepest descent zigzags, whereas Newton's
    method needs one step.
    """

    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def problem(self, name: str) -> Problem:
        """Return the problem, with a black image of one pixel as reference."""
        return Problem(
            QuadraticRenderer(_MATRIX, np.zeros(2)),
            [Parameter(POINT, initial=np.array(_START))],
            [View(np.zeros((1, 1, 3), np.float32))],
            self.loss,
            truth={POINT: np.zeros(2)},
            name=name,
        )
