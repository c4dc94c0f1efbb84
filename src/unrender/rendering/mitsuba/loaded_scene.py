"""A loaded scene, the values that its parameters were set to, and their leaves of the derivative graph.

A virtual call sees all objects of its kind in the process, whichever scene they belong to. Recorded kernels therefore need every loaded
scene as an input, and forward differentiation needs all other scenes detached. The registry of this module tracks them.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import re
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from unrender.backend import variant
from unrender.core import arrays, memory
from unrender.core.errors import InputError
from unrender.core.text import reason_of
from unrender.core.trees import Tree
from unrender.rendering.mitsuba import spectral_colours
from unrender.rendering.mitsuba.edges import meshed
from unrender.rendering.mitsuba.frozen import FrozenFunction, build_distributions
from unrender.rendering.mitsuba.parameters import from_tensor, is_one_direction, native_shape, normals_key, to_tensor
from unrender.rendering.mitsuba.ranges import SlotReaders
from unrender.rendering.mitsuba.rigid_motions import RigidMotions
from unrender.rendering.mitsuba.scene_graph import ObjectGraph, refusal, replace_meshes
from unrender.rendering.mitsuba.scene_loading import SceneDescription, is_loaded, load_resolved
from unrender.rendering.mitsuba.turned_lights import with_turns
from unrender.rendering.renderer import ReplacedMesh
from unrender.rendering.turns import Turns


class _Registry:
    """Weak references to all loaded scenes of this process, in the order of loading.

    Attributes:
        any_died: whether one died since the last `collect`. Its Mitsuba objects may still live in reference cycles.
        any_tangents: whether any has ever had tangents.
        any_new: whether one was loaded since the last `share_addresses`.
    """

    def __init__(self) -> None:
        self._scenes: dict[int, weakref.ref[LoadedScene]] = {}
        self._serial = itertools.count()
        self.any_died = False
        self.any_tangents = False
        self.any_new = False

    def add(self, scene: LoadedScene) -> None:
        number = next(self._serial)

        def died(reference: weakref.ref[LoadedScene]) -> None:
            self._scenes.pop(number, None)
            self.any_died = True

        self._scenes[number] = weakref.ref(scene, died)
        self.any_new = True

    def scenes(self) -> list[LoadedScene]:
        alive = [scene for reference in list(self._scenes.values()) if (scene := reference()) is not None]
        return [scene for scene in alive if scene.variant == mi.variant()]  # kernels cannot mix variants

    def collect(self) -> None:
        """Free the objects of dead scenes, which virtual calls would still see."""
        if self.any_died:
            gc.collect()
            self.any_died = False


_registry = _Registry()


def loaded_scenes() -> list[LoadedScene]:
    """Return all loaded scenes of this process and of the active variant, in the order of loading."""
    return _registry.scenes()


def detach_all() -> None:
    """Detach all scenes from the derivative graph, if any has ever had tangents. Their values do not change."""
    if _registry.any_tangents:
        for scene in loaded_scenes():
            scene.detach()


def share_addresses(others: Sequence[mi.Scene] = ()) -> None:
    """Make scenes loaded since the last call, and `others`, share the variables that they would share after the first replay of a
    recording.

    On a CPU, each scene holds the addresses of Embree's functions in its own variables. A replay merges equal addresses into one
    variable and assigns it to all scenes. This changes the input of every recording, so all would be recorded again during a run.
    """
    scenes = [*(loaded.scene for loaded in loaded_scenes()), *others]
    if (others or _registry.any_new) and len(scenes) > 1:
        recorded = FrozenFunction(lambda scenes, number: number + 1)
        for _ in range(2):
            dr.eval(recorded(lambda: None, scenes, dr.opaque(mi.Float, 0)))
    _registry.any_new = False


_OF_MITSUBA = re.compile(r"\[\w+\.(h|cpp):\d+\]")
"""Prefix of exceptions that a Mitsuba plugin throws. Dr.Jit's errors, such as out of memory, do not have it."""


@dataclass(frozen=True)
class _Setting:
    """A value that a parameter was set to, whether as a leaf of the derivative graph, and whether that is spent: its tangents were
    propagated."""

    value: mi.TensorXf
    attached: bool
    spent: bool = False

    def is_of(self, value: mi.TensorXf, attached: bool) -> bool:
        """Return whether setting `value` would change nothing: it has the same memory, which cannot be overwritten while it is
        referenced here."""
        same = self.value.array.index == value.array.index and self.value.shape == value.shape
        return same and self.attached == attached and not self.spent


class LoadedScene:
    """One load of a scene description. It owns its state, except for a scene object that the user has loaded and may change as well.

    Args:
        moving: ids of shapes that move; spheres among them become meshes.
        replaced: {id of a shape: its new mesh}.
        turns: rotations of its lights for each sensor; None for the scene as described.

    Attributes:
        source: what was loaded: the file's path, or the dictionary without the data of grids and bitmaps.
        equal: names of objects, by sets of equal ones (`equal_objects`).
        meshed: ids of spheres that became meshes.
        readers: slots that read the parameters' values.
        colours: parameters whose values are RGB although the scene holds coefficients of spectra.
        parameters: parameters of the scene. Write to them through `set_parameters` only.
        leaves: {key: native value} of the parameters that are set and attached to the derivative graph.
    """

    def __init__(
        self,
        description: SceneDescription,
        moving: AbstractSet[str] = frozenset(),
        replaced: Mapping[str, ReplacedMesh] | None = None,
        turns: Turns | None = None,
    ):
        self.scene, self.source, self.equal = load_resolved(description)
        self.variant = mi.variant()
        self._shared = is_loaded(description)
        self.scene, self.meshed = meshed(self.scene, moving) if moving and not self._shared else (self.scene, [])
        replace_meshes(self.scene, replaced or {})
        self.scene = with_turns(self.scene, turns, description)
        self.graph = ObjectGraph(self.scene)
        if reason := refusal(self.scene, self.graph.nodes) or spectral_colours.refusal(self.scene, self.graph.slots):
            del self.scene, self.graph
            gc.collect()  # remaining objects would be called from other scenes' kernels
            raise InputError(f"scene: {reason}")
        self.readers = SlotReaders(self.graph.slots)
        build_distributions(self.scene)
        self.parameters: mi.SceneParameters = self.graph.parameters()
        self.colours = spectral_colours.SpectralColours(self.parameters, self.readers)
        self.leaves: dict[str, Any] = {}
        self._own: dict[str, Any] = {}
        for key in self.parameters.keys():  # noqa: SIM118 (iterating gives pairs)
            value = self.parameters[key]
            if _is_array(value):
                self._own[key] = _reference(value)
        self.poses = RigidMotions(self.scene, self._own)
        self._own |= self.poses.loaded()
        self._settings: dict[str, _Setting] = {}
        self._posed: dict[str, Any] = {}
        self._held: dict[str, Any] = {}  # the scene's own arrays after an update, since a texture stores a copy
        _registry.add(self)

    def value(self, key: str) -> mi.TensorXf:
        """Return the scene's own value of a parameter, as loaded."""
        return self.colours.value(key, to_tensor(self._own[key] if key in self._own else self.parameters[key]))

    def share_values(self, other: LoadedScene) -> None:
        """Replace own large arrays by equal ones of another load of the description, to save memory."""
        for key, value in self._own.items():
            known = other._own.get(key)
            if (
                not memory.is_large(value)
                or type(known) is not type(value)
                or native_shape(known) != native_shape(value)
            ):
                continue
            if dr.all(arrays.flat(known) == arrays.flat(value), axis=None):
                self._own[key] = known

    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Return the shapes of the parameters that are set."""
        return tuple(tuple(setting.value.shape) for setting in self._settings.values())

    def set_parameters(self, values: Tree, attached: AbstractSet[str] = frozenset()) -> None:
        """Set these parameters to these values and all others to the scene's own; those `attached` are leaves of the derivative graph.
        Nothing happens if this is already the case."""
        unset = [key for key in self._settings if key not in values]
        self._restore(unset)
        changed = [key for key, value in values.items() if not self._is_set(key, value, key in attached)]
        # If the user changes a shared scene between two passes, leaves are created within the backward pass of a custom operation.
        # Then all are created: Dr.Jit 1.5 loses gradients if some leaves were created within it and some before.
        written: dict[str, Any] = {}
        for key in values if self._shared and attached and changed else changed:
            value = values[key]
            # Mitsuba ignores an assignment of the array that the scene already holds, so assign a copy.
            native = self.colours.native(key, value if key in changed else _copy(value))
            leaf = written[key] = from_tensor(native, self._own[key])
            self.leaves.pop(key, None)
            if key in attached:
                dr.enable_grad(leaf)
                self.leaves[key] = leaf
            self._settings[key] = _Setting(mi.TensorXf(value), key in attached)
            if key in self.poses:
                self._posed[key] = leaf
            else:
                # Mitsuba normalises a direction when it loads it, but not when it is set, and renders another sky then.
                self.parameters[key] = dr.normalize(leaf) if is_one_direction(key, leaf) else leaf
        plain = [key for key in changed if key not in self.poses]
        if plain:
            self._update(plain)
            self._hold({key: written[key] for key in plain})
        # Unsetting one pose of a target restores the target, so its other poses have to be written again.
        if self._posed and any(key in self.poses for key in (*changed, *unset)):
            self.poses.write(self.parameters, self._posed)
        if changed and self._shared:
            held = [key for key in self._settings if key not in self.poses]
            self._held = {key: _reference(dr.detach(self.parameters[key])) for key in held}

    def _update(self, changed: Sequence[str]) -> None:
        """Propagate the written values in the scene. Raise `InputError` if a Mitsuba plugin refuses them."""
        try:
            with _without_warnings():
                self.parameters.update()
                self._notify(changed)
        except BaseException as error:  # an interrupt too
            for key in changed:  # the scene's state is inconsistent with these values
                self._settings[key] = replace(self._settings[key], spent=True)
            if not isinstance(error, RuntimeError) or not _OF_MITSUBA.search(str(error)):
                raise
            raise InputError(
                f"{', '.join(changed)}: Mitsuba refuses the value; give the parameter bounds: {reason_of(error, 200)}"
            ) from error

    def _notify(self, keys: Iterable[str]) -> None:
        for node in {self.parameters.properties[key][2] for key in keys if key in self.parameters}:
            self.graph.notify_other_owners(node)

    def _is_set(self, key: str, value: mi.TensorXf, attached: bool) -> bool:
        """Return whether the parameter was set to this value and the scene still holds it."""
        if key not in self._settings or not self._settings[key].is_of(value, attached):
            return False
        if not self._shared or key in self.poses:
            return True
        return key in self._held and _index(self.parameters[key]) == _index(self._held[key])

    def _restore(self, keys: list[str]) -> None:
        if not keys:
            return
        for key in keys:
            del self._settings[key]
            self._held.pop(key, None)
            self.leaves.pop(key, None)
            self._posed.pop(key, None)
            if key in self.poses:
                self.poses.restore(self.parameters, key)
            else:
                self.parameters[key] = _reference(self._own[key])
        self.parameters.update()
        self._notify(keys)
        # A mesh recomputes its normals when its vertices are set, even if it was loaded with other normals.
        written = [name for key in keys for name in self.poses.written(key)]
        normals = [name for name in map(normals_key, written) if name in self._own and name not in self._settings]
        for name in normals:
            self.parameters[name] = _reference(self._own[name])
        if normals:
            self.parameters.update()

    def _hold(self, values: Mapping[str, Any]) -> None:
        """Make bitmaps and grids hold the arrays that they were set to, instead of copies.

        Mitsuba stores two copies: one with channels padded to a power of two for kernels, and an unpadded one, which it recomputes from
        the padded one at each access.
        """
        if self._shared:
            return
        for key, value in values.items():
            held: Any = self.parameters[key]
            if dr.is_tensor_v(value) and dr.is_tensor_v(held) and _index(held) != _index(value):
                self.parameters[key] = type(held)(value)
        # The values are equal, so nothing needs an update.
        self.parameters.nodes_to_update.clear()
        self.parameters.update_candidates.clear()

    def detach(self) -> None:
        """Detach the parameters from the derivative graph. Their values do not change."""
        if self.leaves:
            self.set_parameters({key: setting.value for key, setting in self._settings.items()})

    def clear_gradients(self) -> None:
        for leaf in self.leaves.values():
            dr.clear_grad(leaf)

    def take_gradients(self) -> Tree:
        """Return the gradients of all leaves as evaluated tensors, and clear them to free the memory of large arrays."""
        gradients = {
            key: self.colours.pull_back(key, self._settings[key].value, to_tensor(dr.grad(leaf)))
            for key, leaf in self.leaves.items()
        }
        dr.eval(gradients)
        self.clear_gradients()
        if variant.is_gpu():  # a texture's copy gives a leaf one gradient only
            self._spend()
        return gradients

    def set_tangents(self, values: Tree, tangents: Tree, attached: AbstractSet[str]) -> None:
        """Set these parameters to these values, and propagate the tangents of those `attached` to everything that the scene computes
        from them.

        Afterwards the scene's state has tangents without edges to the leaves, and every other scene of the process is detached.
        """
        _registry.collect()
        _registry.any_tangents = True
        for other in loaded_scenes():
            if other is not self:
                other.detach()
        self._spend()
        self.set_parameters(values, attached)
        for key, leaf in self.leaves.items():
            if key not in tangents:
                raise InputError(f"parameter {key}: its tangent is missing")
            dr.clear_grad(leaf)
            tangent = self.colours.push_forward(key, values[key], tangents[key])
            dr.set_grad(leaf, from_tensor(tangent, self._own[key]))
        for leaf in self.leaves.values():
            dr.enqueue(dr.ADMode.Forward, leaf)
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges | dr.ADFlag.ClearInterior)
        self._spend()

    def _spend(self) -> None:
        self._settings = {key: replace(setting, spent=True) for key, setting in self._settings.items()}


@contextlib.contextmanager
def _without_warnings() -> Iterator[None]:
    """Silence Mitsuba, which reports every non-manifold mesh whenever its vertices are set. Problems have their own notice for it."""
    before = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(before)


def _index(value: Any) -> tuple[int, ...]:
    value = dr.detach(value)
    if dr.is_tensor_v(value):
        return (value.array.index,)
    return (value.index,) if dr.depth_v(value) == 1 else tuple(part.index for part in value)


def _is_array(value: Any) -> bool:
    try:
        native_shape(value)
    except TypeError:
        return False
    return not isinstance(value, (int, float))


def _copy(value: mi.TensorXf) -> mi.TensorXf:
    copied = mi.TensorXf(value.array * dr.opaque(mi.Float, 1), tuple(value.shape))
    dr.eval(copied)
    return copied


def _reference(value: Any) -> Any:
    return type(value)(value)
