"""Problem `exponential`: the toy problem of Balint et al. 2023, Fig. 2, without a renderer."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from unrender.core.registry import register
from unrender.gallery import fields
from unrender.losses import L2, Loss
from unrender.rendering.numpy.one_pixel import RATE, ExponentialRenderer
from unrender.scene.parameter import Parameter
from unrender.scene.problem import Problem
from unrender.scene.view import View

_MEAN, _START = 2.0, 1.5


@register(name="exponential", position=13)
@dataclass(frozen=True)
class Exponential:
    """The rate of an exponential distribution from its mean: one number, no renderer.

    The mean is 2, the true rate 0.5, the initial rate 1.5.
    """

    loss: Loss = field(default=L2(), metadata=fields.LOSS)

    def problem(self, name: str) -> Problem:
        """Return the problem, with an image of one pixel that contains the mean."""
        return Problem(
            ExponentialRenderer(1 / _MEAN),
            [Parameter(RATE, initial=_START)],
            [View(np.full((1, 1, 3), _MEAN, np.float32))],
            self.loss,
            truth={RATE: 1 / _MEAN},
            name=name,
        )
