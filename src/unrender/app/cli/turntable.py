"""`unrender turntable`: a turntable video of a run's result under a chosen light."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from unrender.app.cli import arguments
from unrender.app.cli.arguments import MOST_SAMPLES, AllowOutside, Variant
from unrender.core.errors import InputError


def turntable(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="A run folder, or that of a run in stages, for its last one.")
    ],
    environment: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The light: a picture of all directions (.exr, .hdr).")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, max=100_000, help="Frames of one turn.")] = 48,
    rate: Annotated[float, typer.Option(help="Frames a second.")] = 24.0,
    size: Annotated[int, typer.Option(help="Pixels a side.")] = 320,
    spp: Annotated[int, typer.Option(min=1, max=MOST_SAMPLES, help="Samples per pixel.")] = 64,
    elevation: Annotated[float, typer.Option(help="Elevation of the camera in degrees.")] = 15.0,
    up: Annotated[str | None, typer.Option(metavar="X,Y,Z", help="The axis. Default: the cameras' mean.")] = None,
    background: Annotated[str, typer.Option(help="light, black, grey or white.")] = "light",
    out: Annotated[
        Path | None, typer.Option(help=".mp4, .gif, or a folder for PNG files. Default: turntable.mp4 in DIR.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    variant: Variant = "auto",
    allow_outside: AllowOutside = False,
) -> None:
    """Write a video of a run's result that turns once before a camera and a light."""
    from unrender.app.evaluation import videos
    from unrender.display.terminal import Console
    from unrender.runs.progress import Progress

    console = Console(highlight=False)
    if not directory.is_dir():
        raise InputError(f"{directory}: no such run folder")
    directory = arguments.finished_run(directory)
    place = directory / ("turntable.mp4" if videos.has_ffmpeg() else "turntable.gif") if out is None else out
    with Progress(console):
        arguments.use_variant(variant)
        from unrender.app.evaluation.turntable import turntable as write

        axis = None if up is None else _axis(up)
        video = write(directory, place, environment, frames, rate, size, spp, elevation, axis, background, overwrite)
    console.print(f"video: {video}", soft_wrap=True, markup=False)


def _axis(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError as error:
        raise InputError(f"--up {text}: expected three numbers, such as 0,1,0") from error
