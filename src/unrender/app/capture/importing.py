"""Import of a folder of posed photographs as a problem folder."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from PIL import Image

from unrender.app.capture import (
    field_folder,
    formats,
    hull,
    photometric_folder,
    pictures,
    problem_folder,
    silhouettes,
    writing,
)
from unrender.app.capture import mesh as meshes
from unrender.app.capture.capture import Capture, StoredViews, reinterpreted
from unrender.app.capture.formats import lights
from unrender.app.capture.mesh import Mesh
from unrender.app.capture.silhouettes import Silhouettes, overlap, stands_still
from unrender.app.capture.unknowns import DEFAULT, OF_HULL, parse
from unrender.app.capture.views import prepare
from unrender.app.evaluation.measures import fitted, sheet
from unrender.app.exporting.ready_made import file_name
from unrender.app.stages import stages_file
from unrender.backend import variant
from unrender.core import checks, phases
from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive
from unrender.core.text import in_words, printable
from unrender.display.pictures import png
from unrender.io import files

CHECK, SHEET = "check", "check.png"
PROBLEM, STAGES = writing.PROBLEM, stages_file.FILE
MOST_VOXELS = 256
"""Limit of the voxels along the longest side of the hull; memory is cubic in it."""
TURNTABLE = (
    "the background is static: assuming a turntable, with static light relative to the camera (--no-turntable if not)"
)
STILL_LIGHT = (
    "response: light and object are static, so a diffuse point has the same radiance in all photographs, and its colour explains any "
    "curve; only highlights and vignetting determine the response"
)
LIT_DEFAULT = ("colour", "normal")
_NO_SHAPE = "neither masks nor a mesh: give --masks DIR or --mesh FILE, or --field N for a radiance field"
_OF_ASSET = ("masks", "voxels", "faces", "texture", "band", "turntable")
_OF_POSES = ("mesh", "axes", "world_to_camera", "voxels", "faces", "texture", "band", "turntable", "field")
_OF_CHECK = {CHECK, SHEET}
_OF_IMPORT = {*problem_folder.OWN, *field_folder.OWN, SHEET}


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import.

    Attributes:
        mesh: a PLY or OBJ file in the world space of the cameras; None for a hull of the masks.
        masks: a folder of masks with the names of the photographs; None for the masks of the capture.
        kind: a key of `formats.FORMATS`, or "lights"; None to detect it.
        axes: a key of `capture.AXES`, if the files differ from their format; None for the convention of the format.
        world_to_camera: whether matrices are inverse poses; None for the convention of the format.
        resolution: maximum pixels along the longer side of a view, >= 8.
        scale: a scale factor of the photographs in (0, 1], instead of `resolution`; None for `resolution`.
        hold_out: interval of the held-out photographs, >= 2; 0 for none; None for the split of the capture, or 8; 6 for lights.
        voxels: voxels along the longest side of the hull, at most `MOST_VOXELS`.
        faces: approximate number of faces of the hull.
        texture: width and height of the textures in texels.
        unknowns: unknowns of the asset, of `unknowns.NAMES`; None for `unknowns.DEFAULT` with a mesh, `unknowns.OF_HULL` with a hull,
            colour and normals under known lights, radiance and light of a field.
        band: width in pixels of the border of training masks that has a tenth of the weight.
        turntable: whether the object rotated in front of a static camera and light; None to detect it from the background.
        response: response of 8- and 16-bit files: "srgb", "linear", an exponent such as "2.2", or "fit", which is sRGB with `response`
            among the unknowns.
        field: voxels along each side of a radiance field, from 2 to `MOST_VOXELS`, without masks or mesh; None for an asset.

    Raises `InputError` for a value out of range.
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
    response: str = pictures.SRGB

    def __post_init__(self) -> None:
        for name in ("mesh", "masks"):
            value = getattr(self, name)
            object.__setattr__(self, name, None if value is None else checks.path(f"import: {name}", value, "a file"))
        pictures.check_response(self.response)
        if self.unknowns is not None:
            if not isinstance(self.unknowns, (list, tuple)) or not all(isinstance(name, str) for name in self.unknowns):
                raise InputError(f"import: unknowns must be a list of names, got {in_words(self.unknowns)}")
            object.__setattr__(self, "unknowns", self.chosen(()))
        for name, least in (("resolution", 8), ("voxels", 1), ("faces", 1), ("texture", 1), ("band", 0)):
            checks.integer("import", name, getattr(self, name), at_least=least)
        if self.field is not None:
            checks.integer("import", "field", self.field, at_least=2)
            if self.field > MOST_VOXELS or self.mesh is not None:
                raise InputError(f"--field: expected 2 to {MOST_VOXELS} voxels a side, and no --mesh")
        if self.voxels > MOST_VOXELS:
            raise InputError(f"--voxels {self.voxels}: expected 1 to {MOST_VOXELS}")

    def refuse(self, names: Sequence[str], what: str) -> None:
        """Raise `InputError` if one of these options is not its default; `what` has no use for them."""
        for each in fields(self):
            if each.name in names and getattr(self, each.name) != each.default:
                raise InputError(f"--{each.name.replace('_', '-')}: does not apply to {what}; leave it out")

    def chosen(self, default: tuple[str, ...]) -> tuple[str, ...]:
        """Return the selected unknowns, or `default` without a selection, and `response` if it is fitted."""
        fitted = ("response",) if self.response == pictures.FIT else ()
        return parse(",".join((*(default if self.unknowns is None else self.unknowns), *fitted)))


@dataclass(frozen=True)
class Imported:
    """The result of an import.

    Attributes:
        kind: format of the capture.
        views: number of training views.
        size: width and height of the largest view.
        faces: number of faces of the mesh; 0 without a mesh.
        overlaps: overlaps of the silhouettes of the mesh with the masks, in order of the views; empty without masks.
        notices: one line for each omission or change.
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

    An import of one camera under known lights has neither stages nor a mesh.

    Args:
        folder: a folder with photographs and their cameras, or lights.
        out: the new folder.
        options: None for the defaults.
        overwrite: whether an earlier import or check may be replaced. The replacement is atomic, after all files are written.

    Raises:
        InputError: a malformed file, with the expected content, or an option that would be ignored; nothing is written then.
    """
    folder, out = checks.path("import_capture: folder", folder), checks.path("import_capture: out", out)
    checks.optional("import_capture: options", options, ImportOptions, "an ImportOptions")
    options = options or ImportOptions()
    if not overwrite and out.is_dir() and any(out.iterdir()):
        raise InputError(f"import_capture: {out}: not empty; give overwrite=True to replace an earlier import")
    _check_place(out, folder, options, _OF_IMPORT | _OF_CHECK)
    if formats.is_lit(folder, options.kind):
        return _import_lit(folder, out, options)
    if options.field is not None:
        return _import_field(folder, out, options)
    data = _read(folder, options, unwrapped=True)
    if data.refusal:
        raise InputError(f"{folder}: {data.refusal}")
    mesh = data.mesh
    if mesh.uv is None:
        with phases.phase("atlas"):
            mesh = meshes.unwrap(mesh, options.texture)

    def fill(place: Path) -> None:
        with phases.phase("problem"):
            name, chosen = folder.resolve().name, options.chosen(OF_HULL if options.mesh is None else DEFAULT)
            views = data.views, mesh, data.silhouettes
            problem_folder.write(place, name, *views, options.texture, chosen, options.band, data.turntable)
            shown = silhouettes.chosen(len(data.views))
            cells = [fitted(silhouettes.overlay(data.views[index], data.silhouettes)) for index in shown]
            (place / SHEET).write_bytes(_sheet(data, cells))

    _write_folder(out, fill)
    return _imported(data, out, mesh)


def _import_lit(folder: Path, out: Path, options: ImportOptions) -> Imported:
    options.refuse(_OF_POSES, "one camera under known lights")
    if options.response != pictures.SRGB:
        raise InputError(
            "--response: with one camera under known lights, the better fit of sRGB and linear is selected automatically"
        )
    variant.ensure()
    capture = lights.read(folder, options.masks)
    with phases.phase("photographs"):
        views = photometric_folder.prepare(capture, options.resolution, options.scale, options.hold_out)
    name = folder.resolve().name
    chosen = options.unknowns or LIT_DEFAULT
    _write_folder(out, lambda place: photometric_folder.write(place, name, views, chosen))
    held_out = sum(views.held_out)
    notices = ["one camera under known lights: recovering normals and colours of a flat plate, without cast shadows"]
    if views.linear:
        notices.append("values are interpreted as linear: a diffuse surface fits them better than sRGB values")
    notices += pictures.notices(capture.photographs, "exposure" in chosen, pictures.FIT)
    size = views.mask.shape[1], views.mask.shape[0]
    return Imported(out, formats.LIGHTS, len(views.names) - held_out, held_out, size, 0, (), tuple(notices))


def _import_field(folder: Path, out: Path, options: ImportOptions) -> Imported:
    options.refuse(_OF_ASSET, "a radiance field")
    assert options.field is not None
    if options.response == pictures.FIT:
        raise InputError(
            "--response fit: a radiance field can represent any curve; expected srgb, linear or an exponent"
        )
    voxels, chosen = options.field, options.unknowns or field_folder.NAMES[:2]
    if others := [one for one in chosen if one not in field_folder.NAMES]:
        raise InputError(f"--unknowns {others[0]}: expected light, exposure or both for a radiance field")
    variant.ensure()
    capture = _capture(folder, options)
    views, notices = _views(capture, options, masks=False)
    name = folder.resolve().name
    _write_folder(out, lambda place: field_folder.write(place, name, views, voxels, chosen))
    held_out = sum(view.held_out for view in views.bare())
    size = max((view.lens.width, view.lens.height) for view in views.bare())
    return Imported(out, capture.kind, len(views) - held_out, held_out, size, 0, (), (*capture.notices, *notices))


def _capture(folder: Path, options: ImportOptions) -> Capture:
    capture = formats.read(folder, options.kind, options.masks)
    if options.axes is not None or options.world_to_camera is not None:
        inverse = capture.world_to_camera if options.world_to_camera is None else options.world_to_camera
        capture = reinterpreted(capture, options.axes or capture.axes, inverse)
    return capture


def _views(capture: Capture, options: ImportOptions, masks: bool = True) -> tuple[StoredViews, list[str]]:
    with phases.phase("photographs") as advance:
        size = options.resolution, options.scale
        views, lines = prepare(
            capture, *size, options.hold_out, lambda done, n: advance(done / n), options.response, masks=masks
        )
        exposed = "exposure" in (options.unknowns or ())
        photographs = [photograph.file for photograph in capture.photographs]
        return views, lines + pictures.notices(photographs, exposed, options.response)


def check(folder: Path, out: Path, options: ImportOptions) -> tuple[Imported, str]:
    """Draw the mesh, its edges and the mask over each photograph: a PNG file for each, and one contact sheet.

    Returns the result, and one line about the convention that seems wrong; "" if none does. Raises `InputError` as `import_capture` does.
    """
    _check_place(out, folder, options, _OF_CHECK)
    if formats.is_lit(folder, options.kind):
        raise InputError(f"{folder}: one camera under known lights has no poses to check")
    options.refuse(("field", "texture", "band", "unknowns"), "a check of the mesh")
    data = _read(folder, options, unwrapped=False)

    def fill(place: Path) -> None:
        with phases.phase("pictures"):
            (place / CHECK).mkdir()
            shown, thumbnails = set(silhouettes.chosen(len(data.views))), []
            for index, view in enumerate(data.views):
                picture = silhouettes.overlay(view, data.silhouettes)
                name = f"{index:04d}-{file_name(Path(view.name).stem)}.png"
                (place / CHECK / name).write_bytes(png(picture))
                thumbnails += [fitted(picture)] if index in shown else []
            (place / SHEET).write_bytes(_sheet(data, thumbnails))

    _write_folder(out, fill)
    return _imported(data, out, data.mesh), data.refusal


def _check_place(out: Path, folder: Path, options: ImportOptions, own: set[str]) -> None:
    """Raise `InputError` if replacing `out` would remove other files than `own`, those of an earlier import or check."""
    place = os.path.realpath(out)  # `Path.resolve` raises RuntimeError for links in a circle
    if out.name in ("", "..") or Path.cwd().is_relative_to(place):
        raise InputError(f"--out {out}: the current directory or one above it; expected a folder to be made")
    for what, needed in (("FOLDER", folder), ("--masks", options.masks)):
        if needed is not None and Path(os.path.realpath(needed)).is_relative_to(place):
            raise InputError(f"--out {out}: {what} {needed} is inside it and would be removed; give a new folder")
    with files.input_errors(f"--out {out}"):
        others = sorted({path.name for path in out.iterdir()} - own) if out.is_dir() else []
    if others:
        raise InputError(f"--out {out}: contains other files, such as {printable(others[0])}; give a new folder")


def _read(folder: Path, options: ImportOptions, unwrapped: bool) -> _Read:
    """Read the capture, its shape and their overlap; `unwrapped`: whether texture coordinates will be needed."""
    variant.ensure()
    if options.mesh is not None:
        options.refuse(("voxels", "faces"), "a mesh from a file")
    capture = _capture(folder, options)
    own_mesh = None if options.mesh is None else meshes.read(options.mesh)
    if own_mesh is None:
        meshes.check_installed()
    if unwrapped and (own_mesh is None or own_mesh.uv is None):
        meshes.check_atlas_installed()
    maskable = (".exr", ".png", ".tif", ".tiff", ".webp")
    if own_mesh is None and all(p.mask is None and p.file.suffix.lower() not in maskable for p in capture.photographs):
        raise InputError(f"{folder}: {_NO_SHAPE}")
    views, notices = _views(capture, options)
    masked = all(views.masked)
    if own_mesh is None and not masked:
        raise InputError(f"{folder}: {_NO_SHAPE}")
    training = views.of(held_out=False)
    with phases.phase("shape"):
        try:
            mesh = own_mesh or hull.shape(training, options.voxels, options.faces)
            silhouettes = Silhouettes(mesh)
            overlaps = overlap(silhouettes, views) if masked else []
        except InputError as error:
            if str(error) != hull.EMPTY:
                raise
            raise InputError(f"{folder}: {hull.explain(capture, training, None, 0.0)}") from error
        mean = float(np.mean(overlaps)) if masked else 1.0
        refusal = "" if mean >= hull.SUFFICIENT else hull.explain(capture, training, own_mesh, mean)
    turned = stands_still(views) if options.turntable is None else options.turntable
    if turned and options.turntable is None:
        notices.append(TURNTABLE)
    if "response" in options.chosen(DEFAULT) and not turned:
        notices.append(STILL_LIGHT)
    return _Read(capture, views, mesh, silhouettes, overlaps, turned, (*capture.notices, *notices), refusal)


def _sheet(data: _Read, thumbnails: list[Image.Image]) -> bytes:
    overlaps = [f"IoU {value:.3f}  " for value in data.overlaps] or [""] * len(data.views)
    names = [view.name for view in data.views.bare()]
    labels = [f"{overlaps[index]}{printable(names[index])}" for index in silhouettes.chosen(len(names))]
    rows = [(label, [small]) for label, small in zip(labels, thumbnails, strict=True)]
    return sheet(rows, [silhouettes.LEGEND], min(8, math.ceil(math.sqrt(len(rows)))))


def _imported(data: _Read, out: Path, mesh: Mesh) -> Imported:
    held_out = sum(view.held_out for view in data.views.bare())
    size = max((view.lens.width, view.lens.height) for view in data.views.bare())
    counts = len(data.views) - held_out, held_out
    return Imported(out, data.capture.kind, *counts, size, len(mesh.faces), tuple(data.overlaps), data.notices)


def _write_folder(out: Path, fill: Callable[[Path], None]) -> None:
    files.remove_leftovers(out.parent, (out.name,))
    files.write_folder(out, fill, f"--out {out}: cannot be written")
