"""Conversion of parameters, images and gradients between a loop's framework (NumPy, Dr.Jit or PyTorch) and the renderer's arrays.

PyTorch is never imported here first: an array of it can only come from a program that has imported it.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import drjit as dr
import numpy as np

from unrender.core import arrays, checks
from unrender.core.arrays import Array
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
from unrender.core.trees import Tree
from unrender.rendering.renderer import ParameterInfo, Renderer


class _Render(dr.CustomOp):
    """Operation from parameters, tensors attached to the graph, to images that are already rendered."""

    def eval(self, backward: Callable[[tuple[Any, ...]], Tree], images: tuple[Any, ...], values: Tree) -> Any:
        self._backward = backward
        self._shapes = [tuple(image.shape) for image in images]
        several: Any = images
        return several if len(images) > 1 else several[0]

    def backward(self) -> None:
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
        raise RuntimeError("Renderer: forward-mode derivatives are not supported; use dr.backward")

    def name(self) -> str:
        return "unrender.Renderer"


def with_drjit(backward: Callable[[tuple[Any, ...]], Tree], images: tuple[Any, ...], values: Tree) -> tuple[Any, ...]:
    """Return the detached images, attached to `values` in Dr.Jit's derivative graph. `backward` returns the gradient for loss derivatives
    with respect to the images. Forward mode raises `RuntimeError`."""
    attached: Any = dr.custom(_Render, backward, images, values)
    return attached if isinstance(attached, tuple) else (attached,)


def with_torch(
    backward: Callable[[tuple[Any, ...]], list[Any]], images: tuple[Any, ...], values: list[Any]
) -> tuple[Any, ...]:
    """Return the images, on the host, attached to `values` in PyTorch's derivative graph. Second derivatives are not supported.

    Values are moved to the host before the operation, so that PyTorch calls `backward` on the calling thread, which is known to Dr.Jit.
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
            del values
            ctx.backward_pass, ctx.shapes = backward, [(image.shape, image.dtype) for image in images]
            return images

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, *derivatives: Any) -> tuple[Any, ...]:
            complete = tuple(
                torch.zeros(shape, dtype=kind) if one is None else one
                for one, (shape, kind) in zip(derivatives, ctx.shapes, strict=True)
            )
            return None, None, *ctx.backward_pass(complete)

    return Render


@dataclass(frozen=True)
class LoopParameters:
    """Parameters in the loop's framework.

    Attributes:
        values: {key: array} in that framework, in the order of the renderer's keys.
    """

    framework: Framework
    values: dict[str, Any]

    def detached(self) -> LoopParameters:
        """Return the same values, detached from the loop's graph."""

        def detach(x: Any) -> Any:
            return x.detach() if is_torch(x) else dr.detach(x) if arrays.is_drjit(x) else x

        return LoopParameters(self.framework, {key: detach(value) for key, value in self.values.items()})


class Exchange:
    """Converts between a loop's arrays and the renderer's, of `keys` in order; `known` are the descriptions of the parameters."""

    def __init__(self, renderer: Renderer, keys: tuple[str, ...]):
        self._renderer, self._keys = renderer, keys
        self.known: dict[str, ParameterInfo] = {key: renderer.parameters()[key] for key in keys}
        self._on_device = arrays.is_drjit(renderer.array(np.zeros(1)))
        self._warned: set[str] = set()

    def read(self, values: Any) -> LoopParameters:
        """Read the loop's parameters. Shapes and values are not checked, see `tree`.

        Args:
            values: a mapping with at least the keys (a dictionary, an optimizer of Dr.Jit, `mi.SceneParameters`), the array itself if
                there is one key, or None for the scene's values.

        Raises:
            InputError: a key is missing, a value would be ignored, or the values are of several frameworks.
        """
        if values is None:
            return LoopParameters(
                "numpy", {key: arrays.numpy(x) for key, x in self._renderer.values(list(self._keys)).items()}
            )
        if not isinstance(values, Mapping) and not (hasattr(values, "keys") and hasattr(values, "__getitem__")):
            if len(self._keys) > 1:
                raise InputError(f"Renderer: expected {{key: array}} for {', '.join(self._keys)}, got {_kind(values)}")
            values = dict.fromkeys(self._keys, values)
        known = list(values.keys())
        others = [name for name in known if name not in self._keys]
        for key in self._keys:
            if key not in known:
                raise InputError(f"Renderer: no value for parameter {key}{did_you_mean(key, others)}")
        self._refuse_unused(values, others)
        parameters = {key: values[key] for key in self._keys}
        return LoopParameters(framework(parameters.values(), "Renderer"), parameters)

    def _refuse_unused(self, values: Any, others: list[Any]) -> None:
        """Raise `InputError` for values that would be ignored.

        A dictionary may contain only the parameters. An optimizer may contain other variables, but no other parameter of the scene, whose
        gradient would stay zero. `mi.SceneParameters` always contain all of the scene.
        """
        if hasattr(values, "hierarchy"):  # mi.SceneParameters
            return
        if not isinstance(values, dict):
            others = [name for name in others if name in self._renderer.parameters()]
        if others:
            raise InputError(
                f"Renderer: {others[0]} is not one of its parameters{did_you_mean(str(others[0]), self._keys)}; "
                f"it was created for {', '.join(self._keys)}, and would ignore it"
            )

    def tree(self, inputs: LoopParameters) -> Tree:
        """Return the parameters as arrays of the renderer, detached. Raises `InputError` for a wrong shape or NaN."""
        if inputs.framework == "drjit" and self._on_device:
            from unrender.rendering.mitsuba.parameters import to_tensor

            tree = {key: self._fit(key, self._native(key, value, to_tensor)) for key, value in inputs.values.items()}
            dr.make_opaque(tree)
            for key, value in tree.items():
                if not arrays.all_finite(value):
                    _refuse_values(key, arrays.numpy(value))
            return tree
        return {key: self._renderer.array(self._host(key, value)) for key, value in inputs.values.items()}

    def warn_outside(self, tree: Tree) -> None:
        """Warn once per parameter whose values leave their physical range. An optimizer of the loop knows no bounds."""
        for key, values in tree.items():
            low, high = self.known[key].lowest, self.known[key].highest
            if key in self._warned or arrays.all_within(values, low, high):
                continue
            self._warned.add(key)
            limits = ", ".join(checks.limits(low, high))
            text = f"Renderer: {key} is expected to be {limits}, and has values outside: clip it after each step"
            warnings.warn(text, stacklevel=5)

    def attached(self, inputs: LoopParameters) -> Tree:
        """Return the parameters as Dr.Jit arrays that are still attached to the loop's derivative graph."""
        import mitsuba as mi

        def tensor(key: str, value: Any) -> Any:
            if dr.is_tensor_v(value):
                return value
            flat: Any = dr.ravel(value)
            return mi.TensorXf(flat, self.known[key].shape)

        return {
            key: tensor(key, value) if arrays.is_drjit(value) else self._renderer.array(self._host(key, value))
            for key, value in inputs.values.items()
        }

    def image(self, image: Array, inputs: LoopParameters) -> Any:
        """Convert an image of the renderer to the loop's framework: float32, or float64 if its parameters are."""
        match inputs.framework:
            case "numpy":
                return arrays.numpy(image)
            case "drjit":
                if not self._on_device:
                    expected = "give its parameters as NumPy or PyTorch arrays"
                    raise InputError(f"Renderer: this renderer computes in NumPy; {expected}")
                return image
            case "torch":
                like = next(x for x in inputs.values.values() if is_torch(x))
                return to_torch(arrays.numpy(image), like)

    def derivative(self, derivative: Any, shape: tuple[int, ...]) -> Array:
        """Return a loop's derivative by an image as the renderer's array. Raises `InputError` for another shape or non-finite values."""
        got = shape_of(derivative)
        if got != shape:
            raise InputError(f"Renderer: expected the derivative of the loss by the image, {shape}, got {got}")
        if self._on_device and arrays.is_drjit(derivative):
            detached = dr.detach(derivative)
            if not arrays.all_finite(detached):
                _refuse_derivative(arrays.numpy(detached))
            return detached
        values = host(derivative, "Renderer: the derivative of the loss")
        if not np.isfinite(values).all():
            _refuse_derivative(values)
        return self._renderer.array(values)

    def gradient(self, gradient: Tree, inputs: LoopParameters) -> dict[str, Any]:
        """Return a gradient as arrays of the loop, each of the type and shape of its parameter."""
        return {key: self._like(gradient[key], value, inputs) for key, value in inputs.values.items()}

    def _like(self, gradient: Array, value: Any, inputs: LoopParameters) -> Any:
        match inputs.framework:
            case "numpy":
                return arrays.numpy(gradient).reshape(np.shape(value))
            case "torch":
                like = value if is_torch(value) else next(filter(is_torch, inputs.values.values()))
                return to_torch(arrays.numpy(gradient).reshape(shape_of(value)), like)
            case "drjit":
                if not arrays.is_drjit(value):
                    return gradient
                from unrender.rendering.mitsuba.parameters import from_tensor

                return from_tensor(gradient, value)

    def _native(self, key: str, value: Any, to_tensor: Any) -> Array:
        if not arrays.is_drjit(value):
            return self._renderer.array(self._host(key, value))
        try:
            return to_tensor(value)
        except TypeError as error:
            raise InputError(f"parameter {key}: expected shape {self.known[key].shape}, got {_kind(value)}") from error

    def _host(self, key: str, value: Any) -> np.ndarray:
        array = host(value, f"parameter {key}")
        if not np.isfinite(array).all():
            _refuse_values(key, array)
        return self._fit(key, array)

    def _fit(self, key: str, value: Array) -> Array:
        """Return the value if it has the parameter's shape, or another supported resolution; else raise `InputError`."""
        shape, expected = arrays.shape(value), self.known[key].shape
        if shape == expected:
            return value
        if self.known[key].resizable and len(shape) == len(expected) and shape[-1] == expected[-1] and min(shape) > 0:
            return value
        if expected == () and int(np.prod(shape)) == 1:
            return arrays.reshape(value, ())
        raise InputError(f"parameter {key}: expected shape {expected}, got {shape}")


def _kind(value: Any) -> str:
    return type(value).__name__


def _refuse_values(key: str, values: np.ndarray) -> None:
    raise InputError(f"parameter {key}: expected finite numbers, got {_first_of(values)}")


def _refuse_derivative(values: np.ndarray) -> None:
    raise InputError(
        f"Renderer: the derivative of the loss by the image is not finite, {_first_of(values)}; mask such pixels, or keep the loss away "
        "from roots, logarithms and divisions at zero"
    )


def _first_of(values: np.ndarray) -> str:
    """Return a phrase with the first value that is not finite and the number of such values."""
    wrong = np.argwhere(~np.isfinite(values))
    place = tuple(int(n) for n in wrong[0])
    return f"{values[place]} at {place}, one of {len(wrong)} of {values.size} values"


Framework = Literal["numpy", "drjit", "torch"]


def is_torch(x: Any) -> bool:
    """Return whether `x` is a PyTorch tensor."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(x, torch.Tensor)


def framework(values: Iterable[Any], owner: str) -> Framework:
    """Return the framework of some arrays: "numpy" if none is of Dr.Jit or PyTorch.

    Numbers, lists and NumPy arrays may be mixed with arrays of one other framework.

    Raises `InputError` that names `owner` if arrays of Dr.Jit and PyTorch are mixed.
    """
    kinds: set[Framework] = set()
    for value in values:
        if is_torch(value):
            kinds.add("torch")
        elif arrays.is_drjit(value):
            kinds.add("drjit")
    if len(kinds) > 1:
        raise InputError(f"{owner}: arrays of Dr.Jit and of PyTorch are mixed; use one framework for all")
    return kinds.pop() if kinds else "numpy"


def host(x: Any, owner: str) -> np.ndarray:
    """Convert an array of any framework, or nested lists, to NumPy. Waits for the device.

    A NumPy array of float64 is returned itself. Other types than float64 become float32.
    Raises `InputError` that names `owner` if the values are not integers or real numbers.
    """
    if is_torch(x):
        x = x.detach().cpu().numpy()
    elif arrays.is_drjit(x):
        x = x.numpy()
    values = checks.as_array(x, f"{owner}: ")
    if values.dtype.kind not in "fiu":
        raise InputError(f"{owner}: expected an array of numbers, got {type(x).__name__} of {values.dtype}")
    checks.refuse_encoded(values, f"{owner}: ")
    return values if values.dtype == np.float64 else values.astype(np.float32)


def to_torch(values: np.ndarray, like: Any) -> Any:
    """Return `values` as a PyTorch tensor with the type and device of the tensor `like`. The tensor owns its memory."""
    torch = sys.modules["torch"]
    return torch.from_numpy(np.array(values)).to(like)


def shape_of(x: Array) -> tuple[int, ...]:
    """Return the shape of an array of any framework as a tuple of integers."""
    return tuple(int(n) for n in np.shape(x)) if not hasattr(x, "shape") else tuple(int(n) for n in x.shape)
