"""Which convention of a capture looks wrong, found by trying the others: with which of them does the mesh, or a hull, cover the masks?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from unrender.app.capture.capture import Capture
from unrender.app.capture.captured_view import CapturedView, CapturedViews
from unrender.app.capture.conventions import AXES, reinterpreted
from unrender.app.capture.hull import visual_hull
from unrender.app.capture.mesh import Mesh
from unrender.app.capture.silhouettes import Silhouettes, overlap
from unrender.core.errors import InputError

__all__ = ["SUFFICIENT", "Trial", "explain", "trials"]

SUFFICIENT = 0.6
"""Mean intersection over union of silhouettes and masks below which an import is refused."""
_CLEAR = 0.15
"""By how much another convention must be better to be named."""
_VIEWS = 10
_VOXELS = 40
_SCALES = (0.001, 0.01, 0.1, 10.0, 100.0, 1000.0)


@dataclass(frozen=True)
class Trial:
    """Another reading of the same files.

    Attributes:
        what: the convention, for a message.
        remedy: what to type.
        overlap: mean intersection over union with the masks.
    """

    what: str
    remedy: str
    overlap: float


def explain(capture: Capture, views: CapturedViews, mesh: Mesh | None, found: float) -> str:
    """One line on why masks and mesh, or masks and poses, do not fit, where `found` is their overlap as given."""
    whose = "the mesh covers" if mesh is not None else "a shape carved from all masks covers"
    line = f"{whose} the masks with an overlap (IoU) of {found:.2f}, expected at least {SUFFICIENT:g}"
    best = max(trials(capture, views, mesh), key=lambda trial: trial.overlap, default=None)
    if best is None or best.overlap < found + _CLEAR:
        return f"{line}; no other convention of axes fits better: poses, masks or the order of names may be wrong"
    return f"{line}; {best.what} would give {best.overlap:.2f}: {best.remedy}"


def trials(capture: Capture, views: CapturedViews, mesh: Mesh | None) -> list[Trial]:
    """Other conventions of the poses, and of the mesh where there is one, with how well each fits."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), _VIEWS)).round().astype(int))
    few = [_reduced(views[index]) for index in chosen]
    names = [views[index].name for index in chosen]
    found = []
    for axes, inverse in [(axes, inverse) for inverse in (False, True) for axes in AXES]:
        if (axes, inverse) == (capture.axes, capture.world_to_camera):
            continue
        other = {p.name: p.camera_to_world for p in reinterpreted(capture, axes, inverse).photographs}
        posed = [replace(view, camera_to_world=other[name]) for view, name in zip(few, names, strict=True)]
        direction = "world-to-camera" if inverse else "camera-to-world"
        remedy = f"give --axes {axes}" + (f" --{direction}" if inverse != capture.world_to_camera else "")
        found.append(Trial(f"{direction} matrices with {axes} axes", remedy, _fit(posed, mesh)))
    upside_down = [replace(v, camera_to_world=v.camera_to_world @ np.diag([-1.0, -1.0, 1.0, 1.0])) for v in few]
    found.append(Trial("pictures turned by 180°", "turn the photographs and masks", _fit(upside_down, mesh)))
    for what, remedy, moved in _meshes(mesh):
        found.append(Trial(what, remedy, _fit(few, moved)))
    return found


def _meshes(mesh: Mesh | None) -> Iterator[tuple[str, str, Mesh]]:
    if mesh is None:
        return
    x, y, z = np.asarray(mesh.vertices, float).T
    export = "export the mesh with the up axis of the cameras"
    turned = {"z up": (x, -z, y), "y up": (x, z, -y), "x and z turned by 180° about y": (-x, y, -z)}
    turned["x and y turned by 180° about z"] = (-x, -y, z)
    for what, columns in turned.items():
        yield f"a mesh with {what}", export, Mesh(np.stack(columns, 1), mesh.faces)
    for axis, name in enumerate("xyz"):
        sign = np.where(np.arange(3) == axis, -1.0, 1.0)
        yield f"a mesh with {name} mirrored", f"mirror the mesh along {name}", Mesh(mesh.vertices * sign, mesh.faces)
    for scale in _SCALES:
        yield (
            f"a mesh {scale:g} times as large",
            "scale the mesh to the cameras' unit",
            Mesh(mesh.vertices * scale, mesh.faces),
        )


def _fit(views: CapturedViews, mesh: Mesh | None) -> float:
    """Mean overlap; 0 where no hull is left, or the mesh is seen by none."""
    try:
        shape = visual_hull(views, _VOXELS) if mesh is None else mesh
    except InputError:
        return 0.0
    return float(np.mean(overlap(Silhouettes(shape), views)))


def _reduced(view: CapturedView) -> CapturedView:
    """The view at a fourth of the resolution or so."""
    factor = max(1, min(view.lens.width, view.lens.height) // 48)
    width, height = view.lens.width // factor, view.lens.height // factor

    def smaller(values: np.ndarray) -> np.ndarray:
        blocks = values[: height * factor, : width * factor].reshape(height, factor, width, factor)
        return blocks.mean((1, 3))

    lens = replace(
        view.lens,
        width=width,
        height=height,
        fx=view.lens.fx / factor,
        fy=view.lens.fy / factor,
        cx=view.lens.cx / factor,
        cy=view.lens.cy / factor,
    )
    assert view.mask is not None
    return replace(view, lens=lens, mask=smaller(view.mask), shown=smaller(view.shown))
