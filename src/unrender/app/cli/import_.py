"""`unrender import`: a folder of photographs as a problem."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from unrender.app.cli import arguments
from unrender.app.cli.arguments import AllowOutside, Overwrite, Variant
from unrender.core.errors import InputError
from unrender.display.terminal import Console

if TYPE_CHECKING:
    from unrender.app.capture.importing import Imported


_Folder = Annotated[
    Path,
    typer.Argument(
        metavar="FOLDER", help="Folder with transforms.json, a COLMAP model, poses_bounds.npy or lights.txt."
    ),
]
_Mesh = Annotated[
    Path | None, typer.Option(metavar="FILE", help="PLY or OBJ file in the cameras' world. Default: carved from masks.")
]
_Masks = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Masks named like the photographs, white on the object.")
]
_Check = Annotated[
    bool, typer.Option("--check", help="Only draw mesh, edges and masks over the photographs, and check their overlap.")
]
_Resolution = Annotated[int, typer.Option(min=8, help="Maximum number of pixels along the longer side.")]
_Scale = Annotated[float | None, typer.Option(help="Alternative to --resolution: 0.5 halves the width and the height.")]
_HoldOut = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        min=0,
        help="Hold out every Nth photograph, 0 for none. Default: the capture's split, or 8; 6 for lights.",
    ),
]
_Kind = Annotated[
    str | None, typer.Option("--format", help="transforms, colmap, llff or lights, if the folder has several.")
]
_Axes = Annotated[str | None, typer.Option(help="Camera axes: opengl, opencv or llff. Default: those of the format.")]
_Direction = Annotated[
    bool | None,
    typer.Option("--world-to-camera/--camera-to-world", help="Direction of the matrices. Default: that of the format."),
]
_Voxels = Annotated[int, typer.Option(min=16, max=256, help="Voxels of the carved shape along its longest side.")]
_Faces = Annotated[int, typer.Option(min=100, max=1_000_000, help="Maximum number of faces of the carved shape.")]
_Texture = Annotated[int, typer.Option(min=4, max=8192, help="Texels along the sides of the textures.")]
_Unknowns = Annotated[
    str | None,
    typer.Option(
        metavar="NAMES",
        help="Some of colour, roughness, metallic, normal, shape, light, exposure, vignetting, response, poses, with commas. "
        "Default: colour,roughness,metallic,light, and normal of a carved shape.",
    ),
]
_Band = Annotated[
    int,
    typer.Option(
        metavar="N", min=0, max=64, help="Width in pixels of the border inside masks that has a tenth of the weight."
    ),
]

_Response = Annotated[
    str,
    typer.Option(
        metavar="CURVE",
        help="Response of 8- and 16-bit files: srgb, linear, an exponent such as 2.2, or fit to recover it.",
    ),
]
_Turntable = Annotated[
    bool | None,
    typer.Option(
        "--turntable/--no-turntable",
        help="Whether the object rotated before a static camera and light. Default: detected from the background.",
    ),
]
_Field = Annotated[
    int | None,
    typer.Option(metavar="N", min=2, max=256, help="A radiance field of N voxels per side, without masks or mesh."),
]


def import_(
    folder: _Folder,
    mesh: _Mesh = None,
    masks: _Masks = None,
    out: Annotated[Path | None, typer.Option(help="The problem folder. Default: a new one in out/.")] = None,
    check: _Check = False,
    resolution: _Resolution = 256,
    scale: _Scale = None,
    hold_out: _HoldOut = None,
    kind: _Kind = None,
    axes: _Axes = None,
    world_to_camera: _Direction = None,
    voxels: _Voxels = 96,
    faces: _Faces = 10_000,
    texture: _Texture = 512,
    unknowns: _Unknowns = None,
    band: _Band = 0,
    response: _Response = "srgb",
    turntable: _Turntable = None,
    field: _Field = None,
    overwrite: Overwrite = False,
    variant: Variant = "auto",
    allow_outside: AllowOutside = False,
) -> None:
    """Write a problem from posed photographs: scene, undistorted references, masks, a first shape, problem.toml, held-out.toml."""
    from unrender.runs.progress import Progress

    console = Console(highlight=False)
    if not folder.is_dir():
        raise InputError(f"{folder}: {'not a folder' if folder.exists() else 'no such folder'}")
    from unrender.app.capture import importing
    from unrender.app.capture.unknowns import parse

    names = None if unknowns is None else parse(unknowns)
    # fmt: off
    options = importing.ImportOptions(
        mesh, masks, kind, axes, world_to_camera, resolution, scale, hold_out, voxels, faces, texture, names, band, turntable, field,
        response,
    )
    # fmt: on
    marks = (importing.CHECK,) if check else (importing.PROBLEM, importing.CHECK)
    place = arguments.folder(out, f"{folder.resolve().name}-{'check' if check else 'import'}", overwrite, *marks)
    refusal = ""
    try:
        with Progress(console):
            arguments.use_variant(variant)
            if check:
                imported, refusal = importing.check(folder, place, options)
            else:
                imported = importing.import_capture(folder, place, options, overwrite=True)
    finally:
        arguments.remove_if_empty(place)
    _print_summary(console, imported)
    written = place / (importing.SHEET if check else importing.PROBLEM)
    console.say(f"{'pictures' if check else 'problem'}: {written}")
    if refusal:
        raise InputError(f"{folder}: {refusal}")
    if not check:
        _print_next_steps(console, place)


def _print_next_steps(console: Console, place: Path) -> None:
    from unrender.app.capture import importing

    staged = (place / importing.STAGES).is_file()
    names = (
        (importing.SHEET, "overview", ""),
        (importing.STAGES, "next", "60"),
        (importing.PROBLEM, "all parameters at once" if staged else "next", "60"),
    )
    for file, what, seconds in names:
        if (path := place / file).is_file():
            command = f"unrender run {shlex.quote(str(path))} --seconds {seconds}" if seconds else path
            console.say(f"{what}: {command}")


def _print_summary(console: Console, imported: Imported) -> None:
    from statistics import mean

    for notice in imported.notices:
        console.say(f"note: {notice}")
    counts = f"{imported.views} photographs and {imported.held_out} held out"
    shape = f"; a mesh of {imported.faces} faces" if imported.faces else ""
    console.say(f"{imported.kind}: {counts}, {imported.size[0]} x {imported.size[1]}{shape}")
    if imported.overlaps:
        worst = min(imported.overlaps)
        console.say(f"the mesh covers the masks with IoU {mean(imported.overlaps):.3f}, {worst:.3f} at worst")
