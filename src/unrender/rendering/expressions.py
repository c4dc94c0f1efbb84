"""Parameters of a scene as functions of unknowns outside the scene: a renderer that wraps another one."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from unrender.core import arrays, checks, trees
from unrender.core.arrays import Array
from unrender.core.errors import InputError, KeyedError
from unrender.core.text import did_you_mean, in_words, listed
from unrender.core.trees import Tree
from unrender.io import bounded_files, parameter_values
from unrender.rendering.expression_texts import Function, parse
from unrender.rendering.renderer import (
    Derivatives,
    ParameterInfo,
    Renderer,
    RenderSession,
    SampleRequest,
    Space,
    differentiated,
)
from unrender.rendering.wrapper import DerivedRenderer, DerivedSession, combined, layers


@dataclass(frozen=True, eq=False)
class Expression:
    """A parameter of the scene as a differentiable function of unknowns.

    Attributes:
        function: Maps {name: Dr.Jit tensor of the unknown's shape} to a tensor that broadcasts to the parameter's shape.
        text: The text form; None for a Python function.
    """

    key: str
    function: Function
    text: str | None = None

    @classmethod
    def of(cls, key: str, expression: Any) -> Expression:
        """Return the expression for a function or a text. Raises `KeyedError` for other types and malformed texts."""
        if isinstance(expression, str):
            return cls(key, parse(key, expression), expression)
        if not callable(expression):
            raise KeyedError(key, f"expected a function or a text such as '2 * strength', got {in_words(expression)}")
        return cls(key, expression)


class _Reads(Mapping[str, Any]):
    """The values of unknowns by name, at least one, the `names` that were read, in their order, and one of the values that is not counted
    as read."""

    def __init__(self, values: Mapping[str, Any]):
        self._values, self.names = values, dict[str, None]()
        self.like = next(iter(values.values()))

    def __getitem__(self, name: str) -> Any:
        self.names[name] = None
        return self._values[name]

    def __iter__(self):
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


class ExpressionRenderer(DerivedRenderer):
    """A renderer with additional unknowns; some parameters of the scene are functions of these.

    Images and gradients are as unbiased as the inner renderer's: the gradient by an unknown is that by the parameters times the derivatives
    of the functions. Raises `KeyedError` if a function reads a name that is no unknown, fails, or its result does not suit the parameter;
    `InputError` for an unknown that no function reads.
    """

    def __init__(self, inner: Renderer, expressions: Iterable[Expression], unknowns: Mapping[str, np.ndarray]):
        self.expressions = tuple(expressions)
        self.unknowns = {name: np.array(value, np.float32) for name, value in unknowns.items()}
        known = inner.parameters()
        start = {name: inner.array(value) for name, value in self.unknowns.items()}
        self.reads = {one.key: self._checked(one, known, start) for one in self.expressions}
        if unread := next((name for name in start if not any(name in names for names in self.reads.values())), None):
            others = [*(name for names in self.reads.values() for name in names), *known]
            hint = did_you_mean(unread, others)
            raise InputError(f"{unread}: neither a parameter of the scene nor read by an expression{hint}")
        targets = {name: [key for key, names in self.reads.items() if name in names] for name in self.unknowns}
        infos = {name: _info(self.unknowns[name].shape, [known[key] for key in keys]) for name, keys in targets.items()}
        lost = {
            name: key
            for key, names in self.reads.items()
            for name, differentiable in names.items()
            if not differentiable
        }
        for name, key in lost.items():
            reason = f"the function of {key} loses its derivative; compute with the Dr.Jit tensors that it gets"
            infos[name] = replace(infos[name], differentiable=False, reason=reason)
        self._lost = frozenset(lost)
        super().__init__(inner, targets, infos)

    def values(self, keys: list[str]) -> Tree:
        """Return the initial values of unknowns and the values of parameters of the scene."""
        scene = self.inner.values([key for key in keys if key not in self.unknowns])
        own = {key: self.array(self.unknowns[key]) for key in keys if key in self.unknowns}
        return {key: own[key] if key in own else scene[key] for key in keys}

    def prepare(self, keys: list[str], space: Space | None, derivatives: Derivatives = True) -> RenderSession:
        differentiable = differentiated(keys, derivatives)
        if lost := next((key for key in keys if key in differentiable & self._lost), None):
            reason = self._info[lost].reason
            raise InputError(f"parameter {lost}: it cannot be recovered by path gradients, since {reason}")
        return super().prepare(keys, space, derivatives)

    def session(self, inner: RenderSession, differentiable: frozenset[str]) -> RenderSession:
        return _ExpressionSession(self, inner, differentiable)

    def around(self, inner: Renderer) -> ExpressionRenderer:
        return ExpressionRenderer(inner, self.expressions, self.unknowns)

    def evaluated(self, values: Mapping[str, Any]) -> Tree:
        """Return the scene's parameters that depend on any of `values`; unknowns that are not among these have their initial values."""
        missing = {name: self.array(x) for name, x in self.unknowns.items() if name not in values}
        needed = {key for name in values if name in self.unknowns for key in self.members[name]}
        return _evaluated(self.expressions, needed, _Reads({**missing, **values}), self.inner.parameters())

    def scene_values(self, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return {key of the scene: value} for values of unknowns and of the scene's parameters."""
        own = {name: self.array(np.asarray(x, np.float32)) for name, x in values.items() if name in self.unknowns}
        rest = {key: value for key, value in values.items() if key not in self.unknowns}
        return rest | ({key: arrays.numpy(x) for key, x in self.evaluated(own).items()} if own else {})

    def _checked(self, one: Expression, known: Mapping[str, ParameterInfo], start: Tree) -> dict[str, bool]:
        """Return the names that an expression reads, and whether it has a derivative by each."""
        if one.key not in known:
            raise KeyedError(one.key, f"the scene has no parameter {one.key}{did_you_mean(one.key, known)}")
        info = known[one.key]
        if not (info.perturbable or info.differentiable):
            raise KeyedError(one.key, f"{one.key} cannot be a function: {info.reason}")
        leaves = _leaves(start)
        reads = _Reads(leaves)
        try:
            result = _shaped(one, reads, info.shape)
            value = arrays.numpy(dr.detach(result))
        except KeyError as error:
            hint = did_you_mean(str(error.args[0]), start)
            raise KeyedError(one.key, f"no parameter is called {error.args[0]}{hint}") from error
        except KeyedError:
            raise
        except Exception as error:  # a function of the user's, or shapes that do not go together
            words = " ".join(str(error).split())[:200]
            raise KeyedError(one.key, f"it cannot be evaluated at the initial values: {words}") from error
        if not np.isfinite(value).all():
            raise KeyedError(one.key, "it is not finite at the initial values")
        if value.size > 1 and not info.conversion.takes_number and not np.ptp(value):
            raise KeyedError(one.key, f"all of its {value.size} numbers are {value.flat[0]:g} at the initial values")
        if info.welded and parameter_values.at_one_point(value):
            raise KeyedError(one.key, f"all of its {value.size // 3} vertices are at one point at the initial values")
        if not arrays.all_within(value, info.lowest, info.highest):
            limits = " and ".join(checks.limits(info.lowest, info.highest))
            raise KeyedError(
                one.key, f"expected {limits}, got {value.min():g} to {value.max():g} at the initial values"
            )
        if not reads.names:
            raise KeyedError(one.key, "it reads no unknown; set the value in the scene")
        names = tuple(reads.names)
        if not dr.grad_enabled(result):
            return dict.fromkeys(names, False)
        dr.backward(dr.sum(result, axis=None))
        if endless := [name for name in names if not np.isfinite(arrays.numpy(dr.grad(leaves[name]))).all()]:
            raise KeyedError(
                one.key,
                f"its derivative by {listed(endless)} is not finite at the initial values, as that of a root at 0; start elsewhere",
            )
        if len(names) == 1:
            return {names[0]: True}
        # A sum has a derivative if one of its terms has: each unknown is tried without the others'.
        alone = {name: _Reads({**start, **_leaves({name: start[name]})}) for name in names}
        return {name: dr.grad_enabled(_shaped(one, reads, info.shape)) for name, reads in alone.items()}


def with_expressions(renderer: Renderer, expressions: Mapping[str, Any], unknowns: Mapping[str, Any]) -> Renderer:
    """Return the renderer with these expressions; the renderer itself if there are none or it already has them.

    Args:
        renderer: Renders the scene.
        expressions: {key of the scene: function or text}.
        unknowns: {key: initial value} of all unknowns: a number, which becomes (1,), a list, an array or a .npy file. Parameters of the
            scene are ignored.

    Raises:
        KeyedError: See `ExpressionRenderer`.
        InputError: An unknown without a finite initial value.
    """
    layer = expression_layer(renderer)
    held = {} if layer is None else {one.key: one.text or one.function for one in layer.expressions}
    if not expressions or held == dict(expressions):
        return renderer
    known, starts = renderer.parameters(), dict[str, np.ndarray]()
    for name, value in unknowns.items():
        if name in known:
            continue
        try:
            loaded = bounded_files.read_array(Path(value)) if isinstance(value, (str, Path)) else value
            starts[name] = np.atleast_1d(np.asarray(loaded, np.float32))
        except InputError as error:
            raise InputError(f"{name}: initial: {error}") from error
        except (TypeError, ValueError):
            starts[name] = np.full(1, np.nan, np.float32)
        if value is None or not starts[name].size or not np.isfinite(starts[name]).all():
            if value is None and (hint := did_you_mean(name, known)):
                raise InputError(f"{name}: the scene has no parameter {name}{hint}")
            what = "an unknown of expressions needs a finite initial value"
            raise InputError(f"{name}: {what}: a number, or a list or array of these")
    if not starts:
        first = next(iter(expressions))
        raise KeyedError(first, "there is no unknown to read; name one that is no parameter of the scene")
    return ExpressionRenderer(renderer, [Expression.of(key, one) for key, one in expressions.items()], starts)


def expression_layer(renderer: Any) -> ExpressionRenderer | None:
    """Return the `ExpressionRenderer` among nested wrappers; None where there is none."""
    return next((layer for layer in layers(renderer) if isinstance(layer, ExpressionRenderer)), None)


def are_storable(renderer: Any) -> bool:
    """Return whether all expressions of a renderer have a text form."""
    layer = expression_layer(renderer)
    return layer is None or all(one.text is not None for one in layer.expressions)


def _info(shape: tuple[int, ...], targets: list[ParameterInfo]) -> ParameterInfo:
    nonlinear = any(info.nonlinear or info.welded for info in targets)
    return replace(ParameterInfo(shape, **combined(targets)), nonlinear=nonlinear, of_expression=True)


def _evaluated(
    expressions: Iterable[Expression], keys: Collection[str], reads: _Reads, known: Mapping[str, ParameterInfo]
) -> Tree:
    return {one.key: _shaped(one, reads, known[one.key].shape) for one in expressions if one.key in keys}


def _shaped(one: Expression, values: _Reads, shape: tuple[int, ...]) -> Any:
    """Return the value of an expression, of the parameter's shape and of the kind of the unknowns' arrays."""
    like = values.like
    result = one.function(values)
    if result is None or isinstance(result, str):
        raise KeyedError(one.key, f"the function returned {in_words(result)}, expected a Dr.Jit tensor")
    if not arrays.is_drjit(result) or not dr.is_tensor_v(result):
        result = type(like)(result)
    if tuple(result.shape) == shape:
        return result
    if not shape and math.prod(result.shape) == 1:  # an unknown number has the shape (1,)
        return dr.reshape(result, shape)
    try:
        spread = np.broadcast_shapes(tuple(result.shape), shape)
    except ValueError:
        spread = ()
    if spread != shape:
        raise KeyedError(one.key, f"its result has the shape {tuple(result.shape)}, {one.key} has {shape}")
    return result + dr.zeros(type(like), shape)


class _ExpressionSession(DerivedSession):
    """Images and derivatives with respect to unknowns that parameters of the scene depend on. See `RenderSession`."""

    def __init__(self, renderer: ExpressionRenderer, inner: RenderSession, differentiable: frozenset[str]):
        super().__init__(inner, renderer.unknowns)
        self._renderer, self._differentiable = renderer, differentiable

    def image_batch(self, parameters: Tree, request: SampleRequest) -> Array:
        own, rest = self._split(parameters)
        if not own:
            return self._inner.image_batch(rest, request)
        states = [
            self._renderer.scene_values({k: x[n] for k, x in own.items()}) for n in range(len(next(iter(own.values()))))
        ]
        together = {key: np.stack([state[key] for state in states]) for key in states[0]}
        for key, x in together.items():
            if (x == x[:1]).all():  # shared by all, see `RenderSession.image_batch`
                together[key] = np.broadcast_to(x[0], x.shape)
        return self._inner.image_batch({**rest, **together}, request)

    def _inside(self, own: Tree) -> Tree:
        with dr.suspend_grad():
            values = self._renderer.evaluated(own) if own else {}
        arrays.evaluate(values)
        return values

    def _tangents(self, parameters: Tree, tangents: Tree) -> Tree:
        own, _ = self._split(parameters)
        moved, rest = self._split(tangents)
        leaves = _leaves(own)
        results = self._renderer.evaluated(leaves)
        for key, leaf in leaves.items():
            dr.set_grad(leaf, moved[key])
        dr.forward_to(*results.values())
        along = {key: type(x)(dr.grad(x)) for key, x in results.items()}
        arrays.evaluate(along)
        return {**rest, **along}

    def _gradient(self, parameters: Tree, inner_gradient: Tree, paths: Any) -> Tree:
        own, rest = self._split(parameters)
        gradient = {key: inner_gradient[key] for key in rest if key in inner_gradient}
        leaves = _leaves({key: x for key, x in own.items() if key in self._differentiable})
        if not leaves:
            return gradient | trees.zeros_like(own)
        fixed = {key: x for key, x in own.items() if key not in leaves}
        values = self._renderer.evaluated({**fixed, **leaves})
        products: list[Any] = [
            dr.sum(x * dr.detach(inner_gradient[key]), axis=None) for key, x in values.items() if key in inner_gradient
        ]
        total: Any = sum(products[1:], products[0])
        if dr.grad_enabled(total):  # Dr.Jit drops factors of 0, such as those of a value that a view knows
            dr.backward(total)
        own_gradient = {key: type(leaf)(dr.grad(leaf)) for key, leaf in leaves.items()}
        arrays.evaluate(own_gradient)
        return gradient | trees.zeros_like(fixed) | own_gradient


def _leaves(own: Tree) -> Tree:
    """Return copies of arrays as leaves of a derivative graph of their own."""
    leaves = {key: type(x)(dr.detach(x)) for key, x in own.items()}
    for leaf in leaves.values():
        dr.enable_grad(leaf)
    return leaves
