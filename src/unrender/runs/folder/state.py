"""Conversion of states to flat tensors and a JSON skeleton, and back, so that a checkpoint can store any state.

A state is a frozen dataclass of this package or of a module that registered a component (`unrender.register`), or a dictionary, tuple,
list, number, text or array, nested to any depth. An array that occurs twice is stored once, and restored as one object, because
components may compare states by identity.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import drjit as dr
import numpy as np

from unrender.core import arrays, registry
from unrender.core.errors import InputError

_PACKAGE = __name__.partition(".")[0]
_DEEPEST = 64
_HOST, _SCALAR = "numpy", "scalar"
_DEVICE = (
    *(f"TensorX{kind}" for kind in ("f", "f16", "f64", "i", "i64", "u", "u64", "b")),
    *("Float", "Float16", "Float64", "Int", "Int64", "UInt", "UInt64", "Bool"),
)
_FLOATS = (float, np.floating)
_NOT_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


@dataclass(frozen=True)
class Packed:
    """A packed state: its structure as JSON, in which arrays are numbered, and {number as text: array} on the host, which may share its
    memory."""

    skeleton: Any
    tensors: dict[str, np.ndarray]


def pack(state: Any) -> Packed:
    """Pack a state. Waits for the device. Raises `TypeError` for an unsupported part."""
    packer = _Packer()
    return Packed(packer.node(state), packer.tensors)


def unpack(packed: Packed, patterns: Sequence[Any] = ()) -> Any:
    """Restore a state.

    A class is looked up among frozen dataclasses that are already imported: those of this package, of the modules of registered
    components, and those in `patterns`. The name of a module in a file never imports it.

    Args:
        patterns: states of the same components, if their classes are not registered.

    Raises:
        InputError: the skeleton is invalid, or does not fit the tensors.
    """
    unpacker = _Unpacker(
        packed.tensors,
        {_path(type(part)): type(part) for pattern in patterns for part in parts(pattern) if _is_state(type(part))},
    )
    try:
        state = unpacker.node(packed.skeleton, 0)
    except (ValueError, TypeError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"state: cannot be put together: {str(error)[:200]}") from error
    if unused := sorted(set(packed.tensors) - set(unpacker.used)):
        raise InputError(f"state: tensor {unused[0][:60]!r} belongs to nothing")
    return state


@runtime_checkable
class HasForms(Protocol):
    """A state that may have one part for several views."""

    def of_single_views(self) -> Any:
        """Return the equivalent state with a part for each view."""
        ...


def check_alike(state: Any, patterns: Sequence[Any], where: str = "state") -> None:
    """Raise `InputError` unless each part of `state` has the form of that part in one of `patterns`, states of the same components.

    The form is class, keys, lengths, array types and shapes. The first axis of an array on the host may differ, because some states grow
    with the steps. Views are compared one by one (`HasForms`). Where all patterns are empty, a state is accepted that its field's
    annotation allows.
    """
    if all(pattern is None or (isinstance(pattern, (tuple, list, dict)) and not pattern) for pattern in patterns):
        return
    # A number may be NumPy's or Python's: with NumPy arrays, a sum without terms is still Python's.
    if isinstance(state, _FLOATS) and any(isinstance(pattern, _FLOATS) for pattern in patterns):
        return
    fitting = [pattern for pattern in patterns if type(pattern) is type(state)]
    if not fitting:
        expected = " or ".join(sorted({type(pattern).__name__ for pattern in patterns}))
        raise InputError(f"{where}: expected {expected}, got {type(state).__name__}")
    if isinstance(state, HasForms):
        state, fitting = _of_views(state, where), [pattern.of_single_views() for pattern in fitting]
    if dataclasses.is_dataclass(state):
        for each in dataclasses.fields(state):
            part, parts = getattr(state, each.name), [getattr(pattern, each.name) for pattern in fitting]
            if all(one is None for one in parts):
                _check_annotation(part, type(state), each.name, where)
            check_alike(part, parts, f"{where}.{each.name}")
    elif isinstance(state, Mapping):
        fitting = [pattern for pattern in fitting if list(pattern) == list(state)]
        if not fitting:
            raise InputError(f"{where}: other names than expected, {str(list(state))[:80]}")
        for key, value in state.items():
            check_alike(value, [pattern[key] for pattern in fitting], f"{where}[{key!r}]"[:120])
    elif isinstance(state, (tuple, list)):
        fitting = [pattern for pattern in fitting if len(pattern) == len(state)]
        if not fitting:
            raise InputError(f"{where}: expected another length, got {len(state)}")
        for index, value in enumerate(state):
            check_alike(value, [pattern[index] for pattern in fitting], f"{where}[{index}]")
    elif isinstance(state, np.ndarray) or arrays.is_drjit(state):
        _check_array(state, fitting, where)


def _of_views(state: HasForms, where: str) -> Any:
    try:
        return state.of_single_views()
    except (AttributeError, IndexError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{where}: expected the pixels of whole views") from error


def _check_annotation(part: Any, kind: type, name: str, where: str) -> None:
    """Raise `InputError` unless the annotation of this field of a class allows its value. Annotations of other than classes allow any."""
    try:
        hint = typing.get_type_hints(kind)[name]
    except NameError:  # of an import for type checkers only
        return
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    classes = [typing.get_origin(one) or one for one in (typing.get_args(hint) if union else (hint,))]
    if any(one is Any or not isinstance(one, type) for one in classes):
        return
    allowed = (*classes, *((int, np.floating) if float in classes else ()))
    if not isinstance(part, allowed):
        raise InputError(f"{where}.{name}: expected {classes[0].__name__}, got {type(part).__name__}")


def _check_array(array: Any, patterns: list[Any], where: str) -> None:
    grows = isinstance(array, np.ndarray) and array.ndim > 0
    form = (array.dtype if grows else None, arrays.shape(array)[1 if grows else 0 :], len(array.shape))
    for pattern in patterns:
        shape = arrays.shape(pattern)
        if form == (pattern.dtype if grows else None, shape[1 if grows else 0 :], len(shape)):
            return
    raise InputError(f"{where}: expected shape {arrays.shape(patterns[0])}, got {arrays.shape(array)}")


def not_finite(state: Any, where: str = "state") -> str:
    """Return the path of the first number in a state that is not finite: "state.second_moment['wall']"; "" if there is none."""
    if isinstance(state, _FLOATS):
        return "" if math.isfinite(state) else where
    if isinstance(state, np.ndarray) or arrays.is_drjit(state):
        host = arrays.numpy(state)
        return where if host.dtype.kind == "f" and not np.isfinite(host).all() else ""
    return next((place for name, part in _children(state) if (place := not_finite(part, f"{where}{name}"))), "")


@dataclass
class _Packer:
    tensors: dict[str, np.ndarray] = field(default_factory=dict)
    _seen: dict[int, tuple[Any, int]] = field(default_factory=dict)

    def node(self, value: Any) -> Any:
        if value is None or isinstance(value, (bool, str)):
            return value
        if isinstance(value, np.generic):
            return self._array(value, np.asarray(value), _SCALAR)
        if isinstance(value, int):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else {"float": str(value)}
        if isinstance(value, np.ndarray):
            return self._array(value, value, _HOST)
        if arrays.is_drjit(value):
            return self._array(value, None, _device_name(type(value)))
        if isinstance(value, (list, tuple)) and type(value) in (list, tuple):
            return {type(value).__name__: [self.node(part) for part in value]}
        if isinstance(value, Mapping):
            for key in value:
                if type(key) not in (str, int):
                    raise TypeError(f"a state's dictionary has names or whole numbers as keys, got {key!r}")
            return {"dict": [[key, self.node(part)] for key, part in value.items()]}
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            kind = type(value)
            fields = {each.name: self.node(getattr(value, each.name)) for each in dataclasses.fields(value)}
            return {"class": _path(kind), "fields": fields}
        raise TypeError(f"a state is made of dataclasses, arrays and numbers, got {type(value).__name__}")

    def _array(self, original: Any, host: np.ndarray | None, kind: str) -> Any:
        if id(original) not in self._seen:
            array = arrays.view(original) if host is None else host
            if array.dtype.kind not in "fiub":
                raise TypeError(f"a state's arrays are of real numbers, got {array.dtype}")
            number = len(self.tensors)
            # `ascontiguousarray` alone would convert a scalar to one dimension.
            self.tensors[str(number)] = np.ascontiguousarray(array).reshape(array.shape)
            self._seen[id(original)] = original, number  # the reference prevents reuse of its id
        return {"array": self._seen[id(original)][1], "kind": kind}


@dataclass
class _Unpacker:
    tensors: dict[str, np.ndarray]
    classes: Mapping[str, type]
    used: dict[str, tuple[str, Any]] = field(default_factory=dict)

    def node(self, node: Any, depth: int) -> Any:
        if depth > _DEEPEST:
            raise InputError("state: nested too deeply")
        if node is None or isinstance(node, (bool, int, float, str)):
            if isinstance(node, float) and not math.isfinite(node):
                raise InputError("state: a number that is not finite")
            return node
        match node:
            case {"float": str(word), **rest} if not rest and word in _NOT_FINITE:
                return _NOT_FINITE[word]
            case {"array": int(number), "kind": str(kind), **rest} if not rest:
                return self._array(str(number), kind)
            case {"list": list(parts), **rest} if not rest:
                return [self.node(part, depth + 1) for part in parts]
            case {"tuple": list(parts), **rest} if not rest:
                return tuple(self.node(part, depth + 1) for part in parts)
            case {"dict": list(pairs), **rest} if not rest:
                return self._dictionary(pairs, depth)
            case {"class": str(name), "fields": dict(fields), **rest} if not rest:
                kind = self.classes.get(name) or _class(name)
                if set(fields) != {each.name for each in dataclasses.fields(kind)}:
                    names = ", ".join(fields)[:100]
                    raise InputError(
                        f"state: {name} is of another version of unrender (fields {names}); start the run again"
                    )
                return kind(**{key: self.node(part, depth + 1) for key, part in fields.items()})
        raise InputError(f"state: expected a part of a state, got {repr(node)[:80]}")

    def _dictionary(self, pairs: list[Any], depth: int) -> dict[Any, Any]:
        dictionary: dict[Any, Any] = {}
        for pair in pairs:
            match pair:
                case [str() | int() as key, part] if key not in dictionary and not isinstance(key, bool):
                    dictionary[key] = self.node(part, depth + 1)
                case _:
                    raise InputError(f"state: expected [name, part], every name once, got {repr(pair)[:80]}")
        return dictionary

    def _array(self, number: str, kind: str) -> Any:
        if number not in self.tensors:
            raise InputError(f"state: there is no tensor {number[:20]}")
        if number in self.used:
            known, array = self.used[number]
            if known != kind:
                raise InputError(f"state: tensor {number} is of two kinds, {known} and {kind[:40]}")
            return array
        host = self.tensors[number]
        if kind == _HOST:
            array = host
        elif kind == _SCALAR and host.ndim == 0:
            array = host[()]
        elif kind in _DEVICE:
            array = _on_device(host, kind)
        else:
            raise InputError(f"state: unknown kind of array {kind[:40]!r}")
        self.used[number] = kind, array
        return array


def _path(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def parts(state: Any) -> Iterator[Any]:
    """Yield a state and all its parts: fields of dataclasses, values of mappings, and elements of lists and tuples."""
    yield state
    for _, part in _children(state):
        yield from parts(part)


def _children(state: Any) -> Iterable[tuple[str, Any]]:
    """Return the direct parts of a state by their names, such as ".steps", "['wall']" and "[2]"; none for arrays and numbers."""
    if dataclasses.is_dataclass(state) and not isinstance(state, type):
        return ((f".{each.name}", getattr(state, each.name)) for each in dataclasses.fields(state))
    if isinstance(state, Mapping):
        return ((f"[{key!r}]", part) for key, part in state.items())
    return ((f"[{index}]", part) for index, part in enumerate(state)) if isinstance(state, (tuple, list)) else ()


def _is_state(kind: Any) -> bool:
    """Return whether it is a frozen dataclass without `__new__` and `__post_init__`, whose construction runs no other code."""
    return (
        isinstance(kind, type)
        and dataclasses.is_dataclass(kind)
        and kind.__dataclass_params__.frozen  # pyright: ignore[reportAttributeAccessIssue]
        and kind.__dataclass_params__.init  # pyright: ignore[reportAttributeAccessIssue]
        and kind.__new__ is object.__new__
        and not hasattr(kind, "__post_init__")
    )


def _class(name: str) -> type:
    """Return the state class of this name, if it is imported and belongs to this package or a registered component's module."""
    module, _, word = name.rpartition(".")
    ours = module.startswith(f"{_PACKAGE}.")
    home = sys.modules.get(module) if ours or module in registry.state_modules() else None
    kind = vars(home).get(word) if home is not None else None
    if not isinstance(kind, type) or kind.__module__ != module or not _is_state(kind):
        how = (
            "start the run again"
            if ours
            else "install the package that registers its component, or import its module first"
        )
        raise InputError(
            f"state: {name[:80]!r} is not a state of this version of {_PACKAGE}, nor of a registered component; {how}"
        )
    return kind


def _device_name(kind: type) -> str:
    if kind.__name__ not in _DEVICE:
        raise TypeError(f"a state's arrays are tensors or flat arrays, got {kind.__name__}")
    return kind.__name__


def _on_device(host: np.ndarray, name: str) -> Any:
    """Return a Dr.Jit array of the current variant that owns its memory (see `MitsubaRenderer.array`)."""
    import mitsuba as mi

    kind = getattr(sys.modules[mi.Float.__module__], name)
    flat = kind if dr.depth_v(kind) == 1 else dr.array_t(kind)
    if not dr.is_tensor_v(kind) and host.ndim != 1:
        raise InputError(f"state: an array of shape {host.shape}, expected a flat one for {name}")
    expected = np.dtype(_dtype(flat))
    if host.dtype != expected:
        raise InputError(f"state: an array of {host.dtype}, expected {expected} for {name}")
    borrowed = flat(np.ascontiguousarray(host).reshape(-1))
    if host.size == 0:
        return kind(borrowed, host.shape) if dr.is_tensor_v(kind) else borrowed
    owned = borrowed & dr.opaque(flat, True) if dr.is_mask_v(flat) else borrowed * dr.opaque(flat, 1)
    made = kind(owned, host.shape) if dr.is_tensor_v(kind) else owned
    dr.eval(made)
    return made


def _dtype(flat: Any) -> str:
    if dr.is_mask_v(flat):
        return "bool"
    letter = "f" if dr.is_float_v(flat) else "i" if dr.is_signed_v(flat) else "u"
    return f"{letter}{dr.itemsize_v(flat)}"
