"""A render as an operation of PyTorch's derivative graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

# Imported by a loop that has PyTorch's tensors alone.
import torch  # pyright: ignore[reportMissingImports]

Backward = Callable[[tuple[Any, ...]], list[Any]]


class _Render(torch.autograd.Function):
    """From parameters to images that are already rendered.

    The node keeps what the backward pass needs, and nothing that keeps the node: it is freed with the graph of its step.
    """

    @staticmethod
    def forward(ctx: Any, backward: Backward, images: tuple[Any, ...], *values: Any) -> Any:
        """See `torch.autograd.Function`."""
        del values
        ctx.backward_pass, ctx.shapes = backward, [(image.shape, image.dtype) for image in images]
        return images

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *derivatives: Any) -> tuple[Any, ...]:
        """See `torch.autograd.Function`."""
        given = tuple(
            torch.zeros(shape, dtype=kind) if one is None else one
            for one, (shape, kind) in zip(derivatives, ctx.shapes, strict=True)
        )
        return None, None, *ctx.backward_pass(given)


def apply(backward: Backward, images: tuple[Any, ...], values: list[Any]) -> tuple[Any, ...]:
    """The images, on the host, attached to `values`.

    Args:
        backward: from the derivatives of the loss by the images to the gradient of each of `values`, on the host.
        images: tensors on the host.
        values: tensors on any device. On the host before they enter the operation: PyTorch then calls `backward` on the thread that
            called it, which is the one that Dr.Jit knows.
    """
    return _Render.apply(backward, images, *(value.to("cpu") for value in values))
