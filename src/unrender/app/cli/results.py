"""Commands for results: `unrender judge`, on held-out photographs, `turntable`, as a video, `export`, as a scene, `report`, the page of an
earlier run or sweep, and `watch`, a live page of runs."""

from __future__ import annotations

import contextlib
import math
import os
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from unrender.app.cli import arguments
from unrender.app.cli.arguments import MOST_SAMPLES, AllowOutside, Variant
from unrender.core.errors import InputError
from unrender.core.text import did_you_mean
from unrender.display.terminal import Console, columns, echo, plain

if TYPE_CHECKING:
    from unrender.app.evaluation.judge import Judgement
    from unrender.app.sweeps.record import SweepRecord
    from unrender.app.watch import server

_RunFolder = Annotated[
    Path, typer.Argument(metavar="DIR", help="A run folder, or that of a run in stages for its last stage.")
]


def judge(
    directory: _RunFolder,
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
    arguments.check_folder(directory)
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
    directory: _RunFolder,
    environment: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The light: a picture of all directions (.exr, .hdr).")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, max=10_000, help="Number of frames.")] = 48,
    rate: Annotated[float, typer.Option(help="Frames per second, at most 240, and 50 in a .gif.")] = 24.0,
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
    arguments.check_folder(directory)
    from unrender.app.evaluation import turntable
    from unrender.runs.progress import Progress

    console = Console(highlight=False)
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
            help="mitsuba, glb, obj, ply, environment (.exr, .hdr), blender (.glb, light, cameras and a script).",
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


_MOST = 6


def write_page(folder: Path, record: SweepRecord) -> Path:
    """Write compare.html of the six best finished trials; return its path. Raise `InputError` if none has finished."""
    from unrender.app import report
    from unrender.app.sweeps.record import best_folders

    directories = best_folders(folder, record, _MOST)
    if not directories:
        raise InputError(f"{folder}: no trial of the sweep has finished")
    return report.write_comparison(*report.load_comparison(directories), folder)


def report(
    directory: Annotated[
        Path, typer.Argument(metavar="DIR", help="A run folder, that of a run in stages, or a sweep's.")
    ],
) -> None:
    """Rewrite the page of a run folder, or of a sweep's best trials, and print its path."""
    arguments.check_folder(directory)
    from unrender.app.sweeps.record import SWEEP, read_sweep

    if (directory / SWEEP).is_file():
        echo(write_page(directory, read_sweep(directory)))
        return
    from unrender.app import report as pages

    echo(pages.page(arguments.finished_run(directory)))


_NICE = 10


def watch(
    directories: Annotated[
        list[Path],
        typer.Argument(
            metavar="DIR...", help="Run folders of running, finished or future runs; or folders of sweeps or stages."
        ),
    ],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 selects a free one.")] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address without opening a browser.")
    ] = False,
) -> None:
    """Serve a page that shows runs as they go, with buttons to pause, resume and stop them.

    It is served to this machine only, under an address that contains a secret. Ctrl-C ends the page, not the runs.
    """
    from unrender.app.stages import stages_file
    from unrender.app.sweeps.record import watched_folders
    from unrender.app.watch import server
    from unrender.io import bounded_files

    for directory in directories:
        if bounded_files.kind(directory) not in ("", "folder"):
            raise InputError(f"{directory}: a file, expected a run folder")
    staged = [stage for directory in directories for stage in stages_file.run_folders(directory)]
    directories = [run for stage in staged for run in watched_folders(stage)]
    if len({directory.resolve() for directory in directories}) < len(directories):
        raise InputError("watch: a run folder is listed twice")
    for directory in directories:
        if not directory.is_dir():
            echo(f"{directory}: no such folder yet: waiting for a run to begin there{_similar(directory)}")
    with server.listen(port) as opened:
        address = server.Address(opened.getsockname()[1])
        echo(f"watching at {address.url}")
        echo("Ctrl-C stops this page; the runs continue")
        with contextlib.ExitStack() as stack, contextlib.suppress(KeyboardInterrupt):
            # The socket is listening already, so the browser can connect.
            on_admission = None if no_browser else _open(address, stack)
            with contextlib.suppress(OSError):
                os.nice(_NICE)  # give the watched runs priority; not earlier, since the browser would inherit it
            server.serve([directory.absolute() for directory in directories], address, opened, on_admission)


def _similar(directory: Path) -> str:
    siblings: list[str] = []
    with contextlib.suppress(OSError):
        siblings = [path.name for path in directory.parent.iterdir() if path.is_dir()]
    return did_you_mean(directory.name, siblings)


def _open(address: server.Address, stack: contextlib.ExitStack) -> Callable[[], object] | None:
    """Open the page in a browser; return a function to call once the browser has connected."""
    from unrender.app.watch.connections import Redirect

    try:
        redirect = stack.enter_context(Redirect(address.url))
    except OSError as error:
        echo(f"no browser was opened: {error.strerror or error}; open the address by hand", err=True)
        return None
    webbrowser.open(redirect.path.as_uri())
    return redirect.remove
