"""`unrender export`: a run's result as a scene that plain Mitsuba renders."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from unrender.cli import arguments
from unrender.cli.arguments import Variant
from unrender.core.errors import InputError
from unrender.display.terminal import Console

__all__ = ["export"]


def export(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="A run folder.")],
    out: Annotated[Path | None, typer.Option(help="Where the scene goes. Default: the folder scene in DIR.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier export.")] = False,
    spp: Annotated[int, typer.Option(min=1, help="Samples per pixel that the scene asks for.")] = 256,
    variant: Variant = "auto",
) -> None:
    """Write a run's result as a scene folder: XML, textures, meshes, volumes, and the recovered maps alone."""
    from rich.markup import escape

    console = Console(highlight=False)
    if not directory.is_dir():
        raise InputError(f"{directory}: no such run folder")
    arguments.use_variant(variant)
    from unrender.exporting.scene_folder import export as write

    done = write(directory, directory / "scene" if out is None else out, overwrite, spp)
    for notice in done.notices:
        console.print(f"note: {escape(notice)}", soft_wrap=True)
    written = ("values", done.folder) if done.scene is None else ("scene", done.scene)
    console.print(f"{written[0]}: {escape(str(written[1]))}", soft_wrap=True)
