"""A render as an operation of Dr.Jit's derivative graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr

from unrender.core.trees import Tree


class _Render(dr.CustomOp):
    """From parameters, tensors attached to the graph, to images that are already rendered."""

    def eval(self, backward: Callable[[tuple[Any, ...]], Tree], images: tuple[Any, ...], values: Tree) -> Any:
        """See `dr.CustomOp`."""
        del values
        self._backward = backward
        self._shapes = [tuple(image.shape) for image in images]
        several: Any = images
        return several if len(images) > 1 else several[0]

    def backward(self) -> None:
        """See `dr.CustomOp`."""
        found: Any = self.grad_out()
        given: Any = found if isinstance(found, tuple) else (found,)
        kind: Any = type(given[0])
        # A derivative that is the same everywhere comes as a number.
        whole = tuple(
            x if tuple(x.shape) == shape else x + dr.zeros(kind, shape)
            for x, shape in zip(given, self._shapes, strict=True)
        )
        self.set_grad_in("values", self._backward(whole))

    def forward(self) -> None:
        """See `dr.CustomOp`."""
        raise RuntimeError("Renderer: forward-mode derivatives are not computed; use dr.backward")

    def name(self) -> str:
        """For graphs."""
        return "unrender.Renderer"


def apply(backward: Callable[[tuple[Any, ...]], Tree], images: tuple[Any, ...], values: Tree) -> tuple[Any, ...]:
    """The images, attached to `values`.

    Args:
        backward: from the derivatives of the loss by the images to the gradient.
        images: tensors, detached.
        values: {key: tensor}, attached or not.
    """
    found: Any = dr.custom(_Render, backward, images, values)
    return found if isinstance(found, tuple) else (found,)
