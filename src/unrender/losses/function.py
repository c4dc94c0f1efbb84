"""A loss that is a user's function of images, written in Dr.Jit or PyTorch."""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr
import numpy as np

from unrender.core import arrays
from unrender.core.arrays import Array
from unrender.core.errors import InputError, prefixed
from unrender.core.text import in_words, reason_of

Backend = Literal["drjit", "torch"]


@dataclass(frozen=True, eq=False)
class FunctionLoss:
    """Loss f(image) or f(image, reference), a scalar that Dr.Jit or PyTorch differentiates.

    `Problem` wraps any callable loss in this class. The function gets tensors (H, W, 3) of linear radiance. `prepare` determines the
    framework: it calls the function with Dr.Jit tensors and, if that fails or returns no Dr.Jit scalar, with PyTorch tensors.

    It is treated as a loss of full images with a nonlinear derivative. Image noise may bias its gradient, pixel mini-batches do not support
    it, and it gets the reference where a view's mask is 0. Its minimum may differ from the references, so the end of a run is not compared
    with them pixel by pixel, and there are no standard errors from pixels. A file cannot describe a function, so a run with one is resumed
    by `unrender.resume(..., problem=)`.

    Args:
        function: function of the image, or of the image and the reference; arguments with defaults keep them. It must be pure: equal
            images give equal values.
    """

    function: Callable[..., Any]
    linear, pixelwise = False, False  # nothing is known about the function

    def __post_init__(self):
        if isinstance(self.function, type) or not callable(self.function):
            raise InputError(
                f"expected one of unrender.losses, such as L2(), or a function, got {in_words(self.function)}"
            )
        self.takes_reference  # noqa: B018 (raises for arguments that cannot be filled in)

    @functools.cached_property
    def takes_reference(self) -> bool:
        """Return whether the function also takes the reference. Raises `InputError` if it takes neither one nor two arguments."""
        try:
            parameters = inspect.signature(self.function).parameters.values()
        except (TypeError, ValueError):  # compiled code may have no signature
            return True
        positional = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
        required = [p.name for p in positional if p.default is p.empty]
        open_ended = any(p.kind is p.VAR_POSITIONAL for p in parameters)
        named = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.default is p.empty]
        if named or len(required) > 2 or not (positional or open_ended):
            names = ", ".join([*required, *named]) or "nothing"
            raise InputError(f"{self!r}: expected a function of (image) or of (image, reference), it takes {names}")
        return len(required) == 2 or (len(required) < 2 and open_ended)

    def __repr__(self) -> str:
        # Equal in another process, because a resumed run compares it.
        name = getattr(self.function, "__qualname__", None) or type(self.function).__qualname__
        return f"{getattr(self.function, '__module__', '?')}.{name}"

    def prepare(self, reference: np.ndarray) -> None:
        """Determine the function's framework by calling it with a reference (H, W, 3) and an image that differs from it.

        Raises `InputError`, in one line, if it accepts neither framework's tensors or returns no finite scalar.
        """
        self.__dict__["_framework"] = self._detect_framework(reference)

    def value(self, image: Array, reference: Array) -> Array:
        """Return the loss of each image (..., H, W, 3), repeated in all its elements."""
        return _each(lambda one, other: arrays.zeros_like(one) + self._evaluate(one, other, False)[0], image, reference)

    def derivative(self, image: Array, reference: Array) -> Array:
        """Return H · W · 3 times the derivative of each image's loss, (..., H, W, 3)."""
        elements = float(np.prod(arrays.shape(image)[-3:]))
        return _each(lambda one, other: self._evaluate(one, other, True)[1] * elements, image, reference)

    def _detect_framework(self, reference: np.ndarray) -> Backend:
        failures: list[tuple[bool, str]] = []  # whether the function returned, and what is wrong
        image = reference * reference.dtype.type(0.9) + reference.dtype.type(0.05)
        frameworks: tuple[Backend, ...] = ("drjit", "torch")
        for framework in frameworks:
            try:
                value, _ = _CALLS[framework](self, image, reference, True)
            except Exception as error:  # a user's function may raise anything for another framework's arrays
                line = f"with {_NAMES[framework]}'s tensors: {reason_of(error, 160)}"
                failures.append((isinstance(error, InputError), line))
                continue
            if not np.isfinite(value):
                raise InputError(f"{self!r}: its value at an image that is nearly the reference is {value}")
            return framework
        # What it raises for the other framework's tensors says nothing.
        lines = [line for returned, line in failures if returned] or [line for _, line in failures]
        raise InputError(f"{self!r}: expected a function from an image (H, W, 3) to a scalar; {'; '.join(lines)}")

    def _evaluate(self, image: Array, reference: Array, derivative: bool) -> tuple[Array, Array]:
        if "_framework" not in self.__dict__:
            self.prepare(arrays.numpy(reference))
        with prefixed(f"loss: {self!r}"):
            return _CALLS[self.__dict__["_framework"]](self, image, reference, derivative)


def _each(of_one: Callable[[Array, Array], Array], images: Array, references: Array) -> Array:
    """Apply a function of an image (H, W, 3) and its reference to all images (..., H, W, 3)."""
    if len(images.shape) == 3:
        return of_one(images, references)
    several = len(references.shape) > 3 and references.shape[0] > 1
    only_reference = references if len(references.shape) == 3 else references[0]
    results = [
        _each(of_one, images[index], references[index] if several else only_reference)
        for index in range(images.shape[0])
    ]
    return arrays.concatenate([arrays.add_first_axis(one) for one in results])


def _with_drjit(loss: FunctionLoss, image: Array, reference: Array, derivative: bool) -> tuple[Array, Array]:
    kind = type(image) if arrays.is_drjit(image) else _tensor_type(image)
    tensor = _detached(image, kind)
    with dr.resume_grad() if derivative else dr.suspend_grad():
        if derivative:
            dr.enable_grad(tensor)
        # A copy, since a function may change its arguments.
        result = loss.function(kind(tensor), *([_detached(reference, kind)] if loss.takes_reference else []))
        if (
            not arrays.is_drjit(result)
            or dr.width(result) != 1
            or (dr.depth_v(result) > 1 and not dr.is_tensor_v(result))
        ):
            raise InputError(f"it returns {_described(result)}, expected a scalar of Dr.Jit")
        if derivative:
            if not dr.grad_enabled(result):
                raise InputError("its result does not depend on the image, or is detached from it")
            dr.backward(result)
    value, slope = dr.detach(result), dr.grad(tensor) if derivative else tensor
    if not arrays.is_drjit(image):
        return arrays.number(value), slope.numpy()
    return kind(dr.ravel(value), ()), slope


def _detached(x: Array, kind: Any) -> Any:
    return kind(dr.detach(x)) if arrays.is_drjit(x) else kind(np.ascontiguousarray(x))


def _with_torch(loss: FunctionLoss, image: Array, reference: Array, derivative: bool) -> tuple[Array, Array]:
    torch: Any = sys.modules.get("torch")
    if torch is None:  # a function that uses PyTorch has imported it
        raise ImportError("PyTorch is not imported")
    tensor = torch.from_numpy(arrays.numpy(image)).requires_grad_(derivative)
    with torch.set_grad_enabled(derivative):
        result = loss.function(tensor, *([torch.from_numpy(arrays.numpy(reference))] if loss.takes_reference else []))
    if not isinstance(result, torch.Tensor) or result.numel() != 1:
        raise InputError(f"it returns {_described(result)}, expected a scalar of PyTorch")
    if not derivative:
        return float(result), image
    if not result.requires_grad:
        raise InputError("its result does not depend on the image, or is detached from it")
    (slope,) = torch.autograd.grad(result.reshape(()), tensor, materialize_grads=True)
    return float(result.detach()), arrays.like(slope.numpy(), image)


_CALLS: dict[Backend, Callable[[FunctionLoss, Array, Array, bool], tuple[Array, Array]]] = {
    "drjit": _with_drjit,
    "torch": _with_torch,
}
_NAMES: dict[Backend, str] = {"drjit": "Dr.Jit", "torch": "PyTorch"}


def _tensor_type(values: np.ndarray) -> Any:
    """Return Dr.Jit's differentiable tensor type of the current variant, in the precision of `values`."""
    mitsuba = sys.modules.get("mitsuba")
    if mitsuba is not None and mitsuba.variant() is not None:
        module = sys.modules[mitsuba.Float.__module__]
    else:
        from drjit.auto import ad as module
    return module.TensorXf64 if values.dtype == np.float64 else module.TensorXf


def _described(x: Any) -> str:
    shape = getattr(x, "shape", None)
    return f"{type(x).__name__}" + (f" of shape {tuple(shape)}" if shape is not None else "")
