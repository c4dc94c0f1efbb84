"""A loss that is a user's own function of images, written in Dr.Jit or in PyTorch."""

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
from unrender.core.errors import InputError
from unrender.core.text import reason_of

Way = Literal["drjit", "torch"]


@dataclass(frozen=True, eq=False)
class FunctionLoss:
    """f(image) or f(image, reference), a scalar, differentiated by the framework it is written in.

    `Problem` makes one of any callable that it is given as its loss. It is called with tensors (H, W, 3) of linear radiance: with
    Dr.Jit's first and, where that fails or gives no Dr.Jit scalar, with PyTorch's; `prepare` finds out which.

    It counts as a loss of whole images whose derivative is not linear: noise of the image may bias its gradient, pixel mini-batches
    cannot have it, and where a view's mask is 0 it sees the reference. No file can describe a function, so a run with one is resumed by
    `unrender.resume(..., problem=)`.

    Args:
        function: of one argument, the image, or of two, the image and the reference; arguments with defaults are left alone. Must be
            pure: called again with the same image, it gives the same value.
    """

    function: Callable[..., Any]

    def __post_init__(self):
        if isinstance(self.function, type) or not callable(self.function):
            raise InputError(f"expected one of unrender.losses, such as L2(), or a function, got {self.function!r:.80}")
        self.takes_reference  # noqa: B018 (raises for arguments that cannot be filled in)

    @property
    def linear(self) -> bool:
        """False: nothing is known of it."""
        return False

    @property
    def pixelwise(self) -> bool:
        """False: nothing is known of it."""
        return False

    @functools.cached_property
    def takes_reference(self) -> bool:
        """Whether it is given the reference too. Raises `InputError` where it takes neither one nor two arguments."""
        try:
            parameters = inspect.signature(self.function).parameters.values()
        except (TypeError, ValueError):  # of compiled code, which may not tell
            return True
        given = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
        required = [p.name for p in given if p.default is p.empty]
        open_ended = any(p.kind is p.VAR_POSITIONAL for p in parameters)
        named = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.default is p.empty]
        if named or len(required) > 2 or not (given or open_ended):
            names = ", ".join([*required, *named]) or "nothing"
            raise InputError(f"{self!r}: expected a function of (image) or of (image, reference), it takes {names}")
        return len(required) == 2 or (len(required) < 2 and open_ended)

    def __repr__(self) -> str:
        # The same in another process: what a resumed run compares.
        name = getattr(self.function, "__qualname__", None) or type(self.function).__qualname__
        return f"{getattr(self.function, '__module__', '?')}.{name}"

    def prepare(self, reference: np.ndarray) -> None:
        """Find out which framework it is written in, from its answer to a reference (H, W, 3) and an image that differs from it.

        Raises `InputError`, in one line, where it takes neither's tensors, or gives no finite scalar.
        """
        self.__dict__["_way"] = self._find_way(reference)

    def value(self, image: Array, reference: Array) -> Array:
        """See `Loss.value`: of images (..., H, W, 3), the loss of each, everywhere in it."""
        return _each(lambda one, other: arrays.zeros_like(one) + self._evaluate(one, other, False)[0], image, reference)

    def derivative(self, image: Array, reference: Array) -> Array:
        """See `Loss.derivative`: of images (..., H, W, 3), H · W · 3 times the derivative of the loss."""
        elements = float(np.prod(arrays.shape(image)[-3:]))
        return _each(lambda one, other: self._evaluate(one, other, True)[1] * elements, image, reference)

    def _find_way(self, reference: np.ndarray) -> Way:
        said, image = [], reference * reference.dtype.type(0.9) + reference.dtype.type(0.05)
        ways: tuple[Way, ...] = ("drjit", "torch")
        for way in ways:
            try:
                value, _ = _CALLS[way](self, image, reference, True)
            except Exception as error:  # whatever a user's function raises for arrays of another framework
                said.append(f"with {_NAMES[way]}'s tensors: {reason_of(error, 160)}")
                continue
            if not np.isfinite(value):
                raise InputError(f"{self!r}: its value at an image that is nearly the reference is {value}")
            return way
        raise InputError(f"{self!r}: expected a function from an image (H, W, 3) to a scalar; {'; '.join(said)}")

    def _evaluate(self, image: Array, reference: Array, derivative: bool) -> tuple[Array, Array]:
        """The loss of one image (H, W, 3) and, where it is asked for, its derivative."""
        if "_way" not in self.__dict__:
            self.prepare(arrays.numpy(reference))
        return _CALLS[self.__dict__["_way"]](self, image, reference, derivative)


def _each(of_one: Callable[[Array, Array], Array], images: Array, references: Array) -> Array:
    """A function of an image (H, W, 3) and its reference, applied to all of (..., H, W, 3)."""
    if len(images.shape) == 3:
        return of_one(images, references)
    several = len(references.shape) > 3 and references.shape[0] > 1
    alone = references if len(references.shape) == 3 else references[0]
    found = [_each(of_one, images[index], references[index] if several else alone) for index in range(images.shape[0])]
    return arrays.concatenate([arrays.add_first_axis(one) for one in found])


def _with_drjit(loss: FunctionLoss, image: Array, reference: Array, derivative: bool) -> tuple[Array, Array]:
    kind = type(image) if arrays.is_drjit(image) else _tensor_type(image)
    given = _detached(image, kind)
    with dr.resume_grad() if derivative else dr.suspend_grad():
        if derivative:
            dr.enable_grad(given)
        found = loss.function(given, *([_detached(reference, kind)] if loss.takes_reference else []))
        if not arrays.is_drjit(found) or dr.width(found) != 1 or (dr.depth_v(found) > 1 and not dr.is_tensor_v(found)):
            raise InputError(f"it returns {_described(found)}, expected a scalar")
        if derivative:
            if not dr.grad_enabled(found):
                raise InputError("what it returns does not depend on the image, or was detached from it")
            dr.backward(found)
    value, slope = dr.detach(found), dr.grad(given) if derivative else given
    if not arrays.is_drjit(image):
        return arrays.number(value), slope.numpy()
    return kind(dr.ravel(value), ()), slope


def _detached(x: Array, kind: Any) -> Any:
    return kind(dr.detach(x)) if arrays.is_drjit(x) else kind(np.ascontiguousarray(x))


def _with_torch(loss: FunctionLoss, image: Array, reference: Array, derivative: bool) -> tuple[Array, Array]:
    torch: Any = sys.modules.get("torch")
    if torch is None:  # a function that is written in it has imported it
        raise InputError("PyTorch is not imported")
    given = torch.from_numpy(arrays.numpy(image)).requires_grad_(derivative)
    with torch.set_grad_enabled(derivative):
        found = loss.function(given, *([torch.from_numpy(arrays.numpy(reference))] if loss.takes_reference else []))
    if not isinstance(found, torch.Tensor) or found.numel() != 1:
        raise InputError(f"it returns {_described(found)}, expected a scalar")
    if not derivative:
        return float(found), image
    if not found.requires_grad:
        raise InputError("what it returns does not depend on the image, or was detached from it")
    (slope,) = torch.autograd.grad(found.reshape(()), given, materialize_grads=True)
    return float(found.detach()), arrays.like(slope.numpy(), image)


_CALLS: dict[Way, Callable[[FunctionLoss, Array, Array, bool], tuple[Array, Array]]] = {
    "drjit": _with_drjit,
    "torch": _with_torch,
}
_NAMES: dict[Way, str] = {"drjit": "Dr.Jit", "torch": "PyTorch"}


def _tensor_type(values: np.ndarray) -> Any:
    """Dr.Jit's differentiable tensor of the variant in use, in the precision of `values`."""
    mitsuba = sys.modules.get("mitsuba")
    if mitsuba is not None and mitsuba.variant() is not None:
        module = sys.modules[mitsuba.Float.__module__]
    else:
        from drjit.auto import ad as module
    return module.TensorXf64 if values.dtype == np.float64 else module.TensorXf


def _described(x: Any) -> str:
    shape = getattr(x, "shape", None)
    return f"{type(x).__name__}" + (f" of shape {tuple(shape)}" if shape is not None else "")
