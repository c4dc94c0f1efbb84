"""`unrender judge`, `turntable` and `export`: a result on held-out photographs, as a video, and as a scene."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from unrender.app.cli import arguments
from unrender.app.cli.arguments import MOST_SAMPLES, AllowOutside, Variant
from unrender.core.errors import InputError
from unrender.display.terminal import Console, columns, plain

if TYPE_CHECKING:
    from unrender.app.evaluation.judge import Judgement


def judge(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="A run folder, or that of a run in stages for its last stage.")
    ],
    held_out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="A problem file with other views. Default: held-out.toml next to the run's problem."
        ),
    ] = None,
    environment: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Another light: a picture of all directions (.exr, .hdr).")
    ] = None,
    spp: Annotated[int, typer.Option(min=1, max=MOST_SAMPLES, help="Samples per pixel.")] = 64,
    out: Annotated[Path | None, typer.Option(help="Output folder. Default: judge in DIR.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier judgement.")] = False,
    variant: Variant = "auto",
    allow_outside: AllowOutside = False,
) -> None:
    """Measure a run's result on held-out photographs: PSNR, SSIM and LPIPS, with pictures of the views and of the light."""
    from unrender.runs.progress import Progress

    console = Console(highlight=False)
    with Progress(console):
        arguments.use_variant(variant)
        from unrender.app.evaluation.judge import judge as measure

        judgement = measure(arguments.finished_run(directory), held_out, environment, spp, out, overwrite)
    _tell(console, judgement)


def _tell(console: Console, judgement: Judgement) -> None:
    if judgement.measures:
        names = {"PSNR": "psnr", "SSIM": "ssim", "LPIPS": "lpips"}
        names = {title: name for title, name in names.items() if judgement.mean[name] is not None}
        table = columns("photograph", *names)
        for photograph, each in zip(judgement.names, judgement.measures, strict=True):
            table.add_row(plain(photograph), *(_number(getattr(each, name), name) for name in names.values()))
        table.add_row("[bold]mean[/]", *(_number(judgement.mean[name], name) for name in names.values()))
        console.print(table)
    if judgement.albedo is not None:
        factors = ", ".join(f"{factor:.3g}" for factor in judgement.albedo.factors)
        console.say(
            f"base colour: RMSE {judgement.albedo.rmse:.4f}, {judgement.albedo.scaled_rmse:.4f} after factors {factors}"
        )
    for notice in judgement.notices:
        console.say(f"note: {notice}")
    console.say(f"overview: {judgement.folder / 'sheet.png'}")


def _number(value: float | None, name: str) -> str:
    if value is None:
        return "–"
    return "∞" if math.isinf(value) else f"{value:.2f}" if name == "psnr" else f"{value:.3f}"


def turntable(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="A run folder, or that of a run in stages for its last stage.")
    ],
    environment: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The light: a picture of all directions (.exr, .hdr).")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, max=10_000, help="Number of frames.")] = 48,
    rate: Annotated[float, typer.Option(help="Frames per second, at most 240.")] = 24.0,
    size: Annotated[int, typer.Option(help="Width and height in pixels, an even number.")] = 320,
    spp: Annotated[int, typer.Option(min=1, max=MOST_SAMPLES, help="Samples per pixel.")] = 64,
    elevation: Annotated[float, typer.Option(help="Elevation of the camera above the horizon in degrees.")] = 15.0,
    up: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Axis of the rotation. Default: the mean up axis of the cameras."),
    ] = None,
    background: Annotated[str, typer.Option(help="Background: light, black, grey or white.")] = "light",
    out: Annotated[
        Path | None, typer.Option(help=".mp4, .gif, or a folder for PNG files. Default: turntable.mp4 in DIR.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    variant: Variant = "auto",
    allow_outside: AllowOutside = False,
) -> None:
    """Write a video of one rotation of a run's result before a camera and a light."""
    from unrender.app.evaluation import turntable
    from unrender.runs.progress import Progress

    console = Console(highlight=False)
    if not directory.is_dir():
        raise InputError(f"{directory}: no such run folder")
    directory = arguments.finished_run(directory)
    notices: list[str] = []
    place = directory / ("turntable.mp4" if turntable.has_ffmpeg() else "turntable.gif") if out is None else out
    with Progress(console):
        arguments.use_variant(variant)
        from unrender.app.evaluation.turntable import turntable as write

        axis = None if up is None else _axis(up)
        look = environment, frames, rate, size, spp, elevation, axis, background
        video = write(directory, place, *look, overwrite, notices.append)
    for notice in notices:
        console.say(f"note: {notice}")
    console.say(f"video: {video}")


def _axis(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError as error:
        raise InputError(f"--up {text}: expected three numbers, such as 0,1,0") from error


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
