"""Rendering as an operation of the derivative graphs of Dr.Jit and PyTorch."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
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


def with_drjit(backward: Callable[[tuple[Any, ...]], Tree], images: tuple[Any, ...], values: Tree) -> tuple[Any, ...]:
    """Return the images, attached to `values` in Dr.Jit's derivative graph. Forward mode raises `RuntimeError`.

    Args:
        backward: function from the loss derivatives with respect to the images to the gradient, {key: tensor}.
        images: detached tensors.
        values: {key: tensor}, attached or not.
    """
    attached: Any = dr.custom(_Render, backward, images, values)
    return attached if isinstance(attached, tuple) else (attached,)


def with_torch(
    backward: Callable[[tuple[Any, ...]], list[Any]], images: tuple[Any, ...], values: list[Any]
) -> tuple[Any, ...]:
    """Return the images, on the host, attached to `values` in PyTorch's derivative graph. Second derivatives are not supported.

    Args:
        backward: function from the loss derivatives with respect to the images to the gradient of each of `values`, on the host.
        images: tensors on the host.
        values: tensors on any device. They are moved to the host before the operation, so that PyTorch calls `backward` on the calling
            thread, which is known to Dr.Jit.
    """
    return _torch_operation().apply(backward, images, *(value.to("cpu") for value in values))


@cache
def _torch_operation() -> Any:
    """Return the operation's class. PyTorch, which may be missing, is imported here."""
    import torch  # pyright: ignore[reportMissingImports]

    class Render(torch.autograd.Function):
        """Operation from parameters to images that are already rendered.

        The node refers to the data of the backward pass. None of these refer to the node, so it is freed with the graph of its step.
        """

        @staticmethod
        def forward(ctx: Any, backward: Any, images: tuple[Any, ...], *values: Any) -> Any:
            """Return the images, see `torch.autograd.Function`."""
            del values
            ctx.backward_pass, ctx.shapes = backward, [(image.shape, image.dtype) for image in images]
            return images

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, *derivatives: Any) -> tuple[Any, ...]:
            """Return the gradient of each input, see `torch.autograd.Function`."""
            complete = tuple(
                torch.zeros(shape, dtype=kind) if one is None else one
                for one, (shape, kind) in zip(derivatives, ctx.shapes, strict=True)
            )
            return None, None, *ctx.backward_pass(complete)

    return Render
