# Dr.Jit's stubs know less than its functions return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportReturnType=false

"""Parameters as leaves of the derivative graph, and their gradients as tensors."""

from __future__ import annotations

from typing import Any

import drjit as dr

from unrender.core.trees import Tree
from unrender.rendering.mitsuba.scene_pair import from_tensor, to_tensor


def set_parameters(
    scene: Any, parameters: Tree, native: dict[str, Any], loaded: Tree, leaves: dict[str, Any], attached: bool
) -> None:
    """Bring a scene to `parameters`, as fresh leaves of the gradient: attached for all of a run or never, since frozen kernels would
    be traced anew if that changed between the primal and the adjoint pass."""
    changed = False
    for key, value in parameters.items():
        if loaded.get(key) is not value:
            leaf = from_tensor(value, native[key])
            if attached:
                dr.enable_grad(leaf)
                leaves[key] = leaf
            scene[key] = leaf
            loaded[key] = value
            changed = True
    if changed:
        scene.update()


def gradients(leaves: dict[str, Any]) -> Tree:
    return {key: to_tensor(dr.grad(leaf)) for key, leaf in leaves.items()}
