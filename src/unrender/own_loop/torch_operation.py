"""Rendering as an operation of PyTorch's derivative graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

# Only loops with PyTorch tensors import this module.
import torch  # pyright: ignore[reportMissingImports]

Backward = Callable[[tuple[Any, ...]], list[Any]]


class _Render(torch.autograd.Function):
    """Operation from parameters to images that are already rendered.

    The node refers to the data of the backward pass. None of these refer to the node, so it is freed with the graph of its step.
    """

    @staticmethod
    def forward(ctx: Any, backward: Backward, images: tuple[Any, ...], *values: Any) -> Any:
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


def apply(backward: Backward, images: tuple[Any, ...], values: list[Any]) -> tuple[Any, ...]:
    """Attach the images, on the host, to `values`.

    Args:
        backward: function from the loss derivatives with respect to the images to the gradient of each of `values`, on the host.
        images: tensors on the host.
        values: tensors on any device. They are moved to the host before the operation, so that PyTorch calls `backward` on the calling
            thread, which is known to Dr.Jit.
    """
    return _Render.apply(backward, images, *(value.to("cpu") for value in values))
