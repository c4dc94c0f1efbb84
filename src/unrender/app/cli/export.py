"""`unrender export`: a run's result as a scene for plain Mitsuba, or for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from unrender.app.cli import arguments
from unrender.app.cli.arguments import MOST_SAMPLES, AllowOutside, Variant
from unrender.core.errors import InputError
from unrender.display.terminal import Console


def export(
    context: typer.Context,
    directory: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            help="A run folder, that of a run in stages, or a problem file (TOML) for its initial values.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Output folder. Default: the folder scene in DIR, or NAME-scene in out/.")
    ] = None,
    formats: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="NAME,NAME",
            help="mitsuba, glb, obj, ply, usd, environment (.exr, .hdr), blender (.glb, light, cameras and a script).",
        ),
    ] = "mitsuba",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier export.")] = False,
    spp: Annotated[int, typer.Option(min=1, max=MOST_SAMPLES, help="Samples per pixel in scene.xml.")] = 256,
    variant: Variant = "auto",
    allow_outside: AllowOutside = False,
) -> None:
    """Write a run's result as a scene folder for Mitsuba or for other programs, and the recovered maps alone."""

    console = Console(highlight=False)
    is_problem = directory.suffix.lower() == ".toml" and directory.is_file()
    if not is_problem and not directory.is_dir():
        expected = "a file, expected a run folder or a problem file (.toml)"
        raise InputError(f"{directory}: {expected if directory.exists() else 'no such run folder'}")
    if is_problem:
        arguments.refuse_stages(str(directory))
    directory = directory if is_problem else arguments.finished_run(directory)
    chosen = [name.strip() for name in formats.split(",") if name.strip()]
    if "mitsuba" not in chosen and "--spp" in arguments.typed_options(context):
        raise InputError("--spp: only the format mitsuba writes scene.xml; leave it out")
    arguments.use_variant(variant)
    from unrender.app.exporting.scene_folder import export as write

    default = Path("out", f"{directory.resolve().parent.name}-scene") if is_problem else directory / "scene"
    place = default if out is None else out
    done = write(directory, place, overwrite, spp, chosen)
    for notice in done.notices:
        console.say(f"note: {notice}")
    if done.scene is not None:
        written = ("scene", done.scene)
    else:
        written = ("values" if chosen == ["mitsuba"] else "folder", done.folder)
    console.say(f"{written[0]}: {written[1]}")
