"""A folder of posed photographs becomes a problem folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from unrender.app.capture import (
    atlas,
    decoding,
    field_folder,
    formats,
    hull,
    overlays,
    photometric_folder,
    problem_folder,
    turntable,
    writing,
)
from unrender.app.capture import mesh as meshes
from unrender.app.capture.capture import Capture
from unrender.app.capture.conventions import reinterpreted
from unrender.app.capture.formats import lights
from unrender.app.capture.mesh import Mesh
from unrender.app.capture.silhouettes import Silhouettes, overlap
from unrender.app.capture.stored import StoredViews
from unrender.app.capture.unknowns import DEFAULT, OF_HULL, parse
from unrender.app.capture.views import prepare
from unrender.app.exporting.ready_made import file_name
from unrender.app.stages import stages_file
from unrender.backend import variant
from unrender.core import checks, phases
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.text import printable
from unrender.io import files

CHECK, SHEET = "check", "check.png"
PROBLEM, STAGES = writing.PROBLEM, stages_file.FILE
MOST_VOXELS = 256
"""Along the longest side of the hull: memory grows with the cube."""
TURNTABLE = (
    "the background stands still: a turntable, so the light stands still before the camera, too (--no-turntable if not)"
)
STILL_LIGHT = (
    "response: the light stands still with the object, so a matt point has one radiance in all photographs, and any curve can be "
    "its colour's; highlights and vignetting alone tell it"
)
LIT_DEFAULT = ("colour", "normal")
_OF_CHECK = {CHECK, SHEET}
_OF_IMPORT = {*problem_folder.OWN, *field_folder.OWN, SHEET}


@dataclass(frozen=True)
class ImportOptions:
    """How a capture is read.

    Attributes:
        mesh: a PLY or OBJ file in the cameras' world; None for a hull of the masks.
        masks: a folder of masks named like the photographs; None for those that the capture has.
        kind: a key of `formats.FORMATS`; None for what is found.
        axes: a key of `conventions.AXES`, where the files have others than their format; None for the format's.
        world_to_camera: whether matrices are inverse poses; None for as the format has them.
        resolution: pixels along the longer side of a view, at most.
        scale: in place of `resolution`, a factor of the photograph's own; None for `resolution`.
        hold_out: every so many photographs one is held out; 0 for none; None for the capture's own split, or 8.
        voxels: along the longest side of the hull, at most `MOST_VOXELS`.
        faces: of the hull, about.
        texture: texels along the sides of the textures.
        unknowns: of the asset, of `unknowns.NAMES`; None for `unknowns.DEFAULT` of a mesh that is given, `unknowns.OF_HULL` of a hull,
            colour and normals under known lights, radiance and light of a field.
        band: pixels along the border of masks that count little.
        turntable: whether the object turned before a camera and a light that stood still; None for as the background shows.
        response: of files of 8 or 16 bits: "srgb", "linear", an exponent such as "2.2", or "fit", which is sRGB with `response` among the
            unknowns.
        field: voxels along a side of a radiance field, which needs neither masks nor a mesh; None for an asset.
    """

    mesh: Path | None = None
    masks: Path | None = None
    kind: str | None = None
    axes: str | None = None
    world_to_camera: bool | None = None
    resolution: int = 256
    scale: float | None = None
    hold_out: int | None = None
    voxels: int = 96
    faces: int = 10_000
    texture: int = 512
    unknowns: tuple[str, ...] | None = None
    band: int = 0
    turntable: bool | None = None
    field: int | None = None
    response: str = decoding.SRGB

    def __post_init__(self) -> None:
        for name in ("mesh", "masks"):
            given = getattr(self, name)
            object.__setattr__(self, name, None if given is None else Path(given))
        decoding.check(self.response)
        if self.unknowns is not None:
            object.__setattr__(self, "unknowns", self.chosen(()))
        for name, least in (("resolution", 8), ("voxels", 1), ("faces", 1), ("texture", 1), ("band", 0)):
            checks.integer("import", name, getattr(self, name), at_least=least)
        if self.field is not None:
            checks.integer("import", "field", self.field, at_least=2)
            if self.field > MOST_VOXELS or self.mesh is not None:
                raise InputError(f"--field: expected 2 to {MOST_VOXELS} voxels a side, and no --mesh")
        if self.voxels > MOST_VOXELS:
            raise InputError(f"--voxels {self.voxels}: expected 1 to {MOST_VOXELS}")

    def chosen(self, default: tuple[str, ...]) -> tuple[str, ...]:
        """The unknowns: those given, else these, and `response` where it is to be fitted."""
        fitted = ("response",) if self.response == decoding.FIT else ()
        return parse(",".join((*(default if self.unknowns is None else self.unknowns), *fitted)))


@dataclass(frozen=True)
class Imported:
    """What an import found.

    Attributes:
        folder: what was written.
        kind: the capture's format.
        views: count of training views.
        held_out: count of held-out views.
        size: width and height of the largest view.
        faces: of the mesh; 0 where there is none to look at.
        overlaps: of the mesh's silhouettes with the masks, in order of the views; none where there are no masks.
        notices: one line for each thing that was left out or changed.
    """

    folder: Path
    kind: str
    views: int
    held_out: int
    size: tuple[int, int]
    faces: int
    overlaps: tuple[float, ...]
    notices: tuple[str, ...]


@dataclass(frozen=True)
class _Read:
    capture: Capture
    views: StoredViews
    mesh: Mesh
    silhouettes: Silhouettes
    overlaps: list[float]
    turntable: bool
    notices: tuple[str, ...]
    refusal: str


@exclusive("import_capture")
def import_capture(
    folder: str | Path, out: str | Path, options: ImportOptions | None = None, overwrite: bool = False
) -> Imported:
    """Write the problem of a folder of photographs: scene, problem files, stages, references, masks, mesh, check.png.

    Of one camera under known lights, there are neither stages nor a mesh.

    Args:
        folder: with photographs and their cameras, or lights.
        out: a folder to be made.
        options: None for the defaults.
        overwrite: whether an earlier import or check may be replaced: in one instant, and only when all is written.

    Returns:
        what was found.

    Raises:
        InputError: which file, and what was expected; nothing is written then.
    """
    folder, out = Path(folder), Path(out)
    options = options or ImportOptions()
    if not overwrite and out.is_dir() and any(out.iterdir()):
        raise InputError(f"import_capture: {out}: not empty; give overwrite=True to replace an earlier import")
    _check_place(out, folder, options, _OF_IMPORT | _OF_CHECK)
    if formats.is_lit(folder, options.kind):
        return _import_lit(folder, out, options)
    if options.field is not None:
        return _import_field(folder, out, options)
    found = _read(folder, options, unwrapped=True)
    if found.refusal:
        raise InputError(f"{folder}: {found.refusal}")
    mesh = found.mesh
    if mesh.uv is None:
        with phases.phase("atlas"):
            mesh = atlas.unwrap(mesh, options.texture)

    def fill(place: Path) -> None:
        with phases.phase("problem"):
            name = folder.resolve().name
            problem_folder.write(
                place,
                name,
                found.views,
                mesh,
                found.silhouettes,
                options.texture,
                options.chosen(OF_HULL if options.mesh is None else DEFAULT),
                options.band,
                found.turntable,
            )
            (place / SHEET).write_bytes(
                _sheet(
                    found, [overlays.thumbnail(_overlay(found, index)) for index in overlays.chosen(len(found.views))]
                )
            )

    _write_folder(out, fill)
    return _imported(found, out, mesh)


def _import_lit(folder: Path, out: Path, options: ImportOptions) -> Imported:
    """One camera under known lights."""
    if options.response != decoding.SRGB:
        raise InputError(
            "--response: of one camera under known lights, sRGB or linear is chosen by what explains the photographs"
        )
    variant.ensure()
    capture = lights.read(folder, options.masks)
    with phases.phase("photographs"):
        views = photometric_folder.prepare(capture, options.resolution, options.scale, options.hold_out)
    name = folder.resolve().name
    chosen = options.unknowns or LIT_DEFAULT
    _write_folder(out, lambda place: photometric_folder.write(place, name, views, chosen))
    held_out = sum(views.held_out)
    notices = ["one camera under known lights: normals and colours of a plate, without shadows that it casts"]
    if views.linear:
        notices.append("values are taken as linear: a matt surface explains them better than as sRGB")
    size = views.mask.shape[1], views.mask.shape[0]
    return Imported(out, formats.LIGHTS, len(views.names) - held_out, held_out, size, 0, (), tuple(notices))


def _import_field(folder: Path, out: Path, options: ImportOptions) -> Imported:
    """What has no surface."""
    assert options.field is not None
    if options.response == decoding.FIT:
        raise InputError(
            "--response fit: of a radiance field, any curve can be its own; expected srgb, linear or an exponent"
        )
    voxels, chosen = options.field, options.unknowns or field_folder.NAMES[:2]
    if others := [one for one in chosen if one not in field_folder.NAMES]:
        raise InputError(f"--unknowns {others[0]}: of a radiance field, expected some of light, exposure")
    variant.ensure()
    capture = _capture(folder, options)
    with phases.phase("photographs") as advance:
        views, notices = prepare(
            replace(capture, photographs=tuple(replace(one, mask=None) for one in capture.photographs)),
            options.resolution,
            options.scale,
            options.hold_out,
            lambda done, count: advance(done / count),
            options.response,
        )
    name = folder.resolve().name
    _write_folder(out, lambda place: field_folder.write(place, name, views, voxels, chosen))
    held_out = sum(view.held_out for view in views.bare())
    size = max((view.lens.width, view.lens.height) for view in views.bare())
    return Imported(out, capture.kind, len(views) - held_out, held_out, size, 0, (), (*capture.notices, *notices))


def _capture(folder: Path, options: ImportOptions) -> Capture:
    """What the folder holds, in the conventions that were asked for."""
    capture = formats.read(folder, options.kind, options.masks)
    if options.axes is not None or options.world_to_camera is not None:
        inverse = capture.world_to_camera if options.world_to_camera is None else options.world_to_camera
        capture = reinterpreted(capture, options.axes or capture.axes, inverse)
    return capture


def check(folder: Path, out: Path, options: ImportOptions) -> tuple[Imported, str]:
    """Draw the mesh, its edges and the mask over each photograph: a PNG file for each, and one of them all.

    Returns what was found, and in one line which convention looks wrong, "" where none does.

    Raises:
        InputError: which file, and what was expected; nothing is written then.
    """
    _check_place(out, folder, options, _OF_CHECK)
    if formats.is_lit(folder, options.kind):
        raise InputError(f"{folder}: one camera under known lights has no poses to check")
    found = _read(folder, options, unwrapped=False)

    def fill(place: Path) -> None:
        with phases.phase("pictures"):
            (place / CHECK).mkdir()
            shown, thumbnails = set(overlays.chosen(len(found.views))), []
            for index, view in enumerate(found.views):
                picture = _overlay(found, index)
                name = f"{index:04d}-{file_name(Path(view.name).stem)}.png"
                (place / CHECK / name).write_bytes(overlays.png(picture))
                thumbnails += [overlays.thumbnail(picture)] if index in shown else []
            (place / SHEET).write_bytes(_sheet(found, thumbnails))

    _write_folder(out, fill)
    return _imported(found, out, found.mesh), found.refusal


def _check_place(out: Path, folder: Path, options: ImportOptions, own: set[str]) -> None:
    """Raise `InputError` where replacing `out` would remove more than an earlier import's or check's files, `own`."""
    place = out.resolve()
    if out.name in ("", "..") or Path.cwd().is_relative_to(place):
        raise InputError(f"--out {out}: the current directory or one above it; expected a folder to be made")
    for what, needed in (("FOLDER", folder), ("--masks", options.masks)):
        if needed is not None and needed.resolve().is_relative_to(place):
            raise InputError(f"--out {out}: {what} {needed} lies in it and would be removed; give a new one")
    try:
        others = sorted({path.name for path in out.iterdir()} - own) if out.is_dir() else []
    except OSError as error:
        raise InputError(f"--out {out}: {error.strerror or error}") from error
    if others:
        raise InputError(f"--out {out}: holds other things, such as {printable(others[0])}; give a new one")


def _read(folder: Path, options: ImportOptions, unwrapped: bool) -> _Read:
    """What the folder holds, its shape and how they fit; `unwrapped`: whether texture coordinates will be needed."""
    variant.ensure()
    capture = _capture(folder, options)
    given = None if options.mesh is None else meshes.read(options.mesh)
    if given is None:
        meshes.check_installed()
    if unwrapped and (given is None or given.uv is None):
        atlas.check_installed()
    if given is None and not _has_masks(capture):
        raise InputError(f"{folder}: neither masks nor a mesh: give --masks D or --mesh M")
    with phases.phase("photographs") as advance:
        views, notices = prepare(
            capture,
            options.resolution,
            options.scale,
            options.hold_out,
            lambda done, count: advance(done / count),
            options.response,
        )
    masked = all(views.masked)
    if given is None and not masked:
        raise InputError(f"{folder}: neither masks nor a mesh: give --masks D or --mesh M")
    training = views.of(held_out=False)
    with phases.phase("shape"):
        try:
            mesh = given or hull.shape(training, options.voxels, options.faces)
            silhouettes = Silhouettes(mesh)
            overlaps = overlap(silhouettes, views) if masked else []
        except InputError as error:
            if str(error) != hull.EMPTY:
                raise
            raise InputError(f"{folder}: {hull.explain(capture, training, None, 0.0)}") from error
        mean = float(np.mean(overlaps)) if masked else 1.0
        refusal = "" if mean >= hull.SUFFICIENT else hull.explain(capture, training, given, mean)
    turned = turntable.stands_still(views) if options.turntable is None else options.turntable
    if turned and options.turntable is None:
        notices.append(TURNTABLE)
    if "response" in options.chosen(DEFAULT) and not turned:
        notices.append(STILL_LIGHT)
    return _Read(capture, views, mesh, silhouettes, overlaps, turned, (*capture.notices, *notices), refusal)


def _has_masks(capture: Capture) -> bool:
    """Whether there are masks as files, or may be some in alpha channels."""
    return any(
        p.mask is not None or p.file.suffix.lower() in (".png", ".tif", ".tiff", ".webp") for p in capture.photographs
    )


def _overlay(found: _Read, index: int) -> np.ndarray:
    return overlays.overlay(found.views[index], found.silhouettes)


def _sheet(found: _Read, thumbnails: list[Image.Image]) -> bytes:
    """Of those of `overlays.chosen`."""
    overlaps = [f"IoU {value:.3f}  " for value in found.overlaps] or [""] * len(found.views)
    names = [view.name for view in found.views.bare()]
    labels = [f"{overlaps[index]}{printable(names[index])}" for index in overlays.chosen(len(names))]
    return overlays.contact_sheet(thumbnails, labels)


def _imported(found: _Read, out: Path, mesh: Mesh) -> Imported:
    held_out = sum(view.held_out for view in found.views.bare())
    size = max((view.lens.width, view.lens.height) for view in found.views.bare())
    counts = len(found.views) - held_out, held_out
    return Imported(out, found.capture.kind, *counts, size, len(mesh.faces), tuple(found.overlaps), found.notices)


def _write_folder(out: Path, fill: Callable[[Path], None]) -> None:
    files.remove_leftovers(out.parent, (out.name,))
    try:
        files.write_folder(out, fill)
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror or error}") from error
