"""Rendering as an operation of Dr.Jit's derivative graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr

from unrender.core.trees import Tree


class _Render(dr.CustomOp):
    """Operation from parameters, tensors attached to the graph, to images that are already rendered."""

    def eval(self, backward: Callable[[tuple[Any, ...]], Tree], images: tuple[Any, ...], values: Tree) -> Any:
        """Return the images, see `dr.CustomOp`."""
        del values
        self._backward = backward
        self._shapes = [tuple(image.shape) for image in images]
        several: Any = images
        return several if len(images) > 1 else several[0]

    def backward(self) -> None:
        """Propagate the images' derivatives to the parameters, see `dr.CustomOp`."""
        gradient: Any = self.grad_out()
        derivatives: Any = gradient if isinstance(gradient, tuple) else (gradient,)
        kind: Any = type(derivatives[0])
        # Dr.Jit passes a constant derivative as a scalar.
        expanded = tuple(
            x if tuple(x.shape) == shape else x + dr.zeros(kind, shape)
            for x, shape in zip(derivatives, self._shapes, strict=True)
        )
        self.set_grad_in("values", self._backward(expanded))

    def forward(self) -> None:
        """Raise `RuntimeError`: forward mode is not supported."""
        raise RuntimeError("Renderer: forward-mode derivatives are not supported; use dr.backward")

    def name(self) -> str:
        """Return the name of the operation in graphs."""
        return "unrender.Renderer"


def apply(backward: Callable[[tuple[Any, ...]], Tree], images: tuple[Any, ...], values: Tree) -> tuple[Any, ...]:
    """Attach the images to `values` in the derivative graph.

    Args:
        backward: function from the loss derivatives with respect to the images to the gradient.
        images: detached tensors.
        values: {key: tensor}, attached or not.
    """
    attached: Any = dr.custom(_Render, backward, images, values)
    return attached if isinstance(attached, tuple) else (attached,)
