"""Parsing of command-line arguments: problems, settings, folders."""

from __future__ import annotations

import contextlib
import math
import os
import re
import shlex
from collections.abc import Collection, Iterable, Mapping
from numbers import Integral
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from unrender.backend import cache, variant
from unrender.core import checks, lazy, phases, registry
from unrender.core.errors import InputError
from unrender.core.random import LARGEST_SEED
from unrender.core.text import did_you_mean, in_words
from unrender.io import confinement

if TYPE_CHECKING:
    from unrender import gallery
    from unrender.app.distributed.cluster import Workers
    from unrender.app.stages import stages_file
    from unrender.io import bounded_files, files
    from unrender.scene import toml_file
    from unrender.scene.problem import Problem
else:  # imported when a command needs them
    gallery, stages_file, toml_file = lazy.modules("gallery", "app.stages.stages_file", "scene.toml_file")
    bounded_files, files = lazy.modules("io.bounded_files", "io.files")

DEFAULT_STEPS = 300
MOST_SAMPLES, MOST_SEEDS, MOST_TRIALS = 1 << 24, 10_000, 100_000
"""Limits of samples per pixel of a picture, of runs of one method or trial, and of trials of a sweep. More would take years."""

ProblemName = Annotated[
    str, typer.Argument(metavar="PROBLEM", help="A problem file (TOML), or a name from the gallery.")
]
ProblemSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--problem-set",
        "-p",
        metavar="NAME=VALUE",
        help="An option of a gallery problem, such as resolution=64. Repeatable.",
    ),
]
Variant = Annotated[str, typer.Option(help=f"Mitsuba's variant: auto, {', '.join(variant.VARIANTS)}.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace earlier results in the folder.")]
Threads = Annotated[
    int | None,
    typer.Option(
        min=1, help="Number of processor threads. With 1, runs on LLVM repeat bit for bit.", show_default=False
    ),
]
CheckpointEvery = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=2**31 - 1,
        help="Steps between checkpoints. Default: about 50, in 1 % of the time.",
        show_default=False,
    ),
]
FinalSpp = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=MOST_SAMPLES,
        help="Samples per pixel of the final pictures. Default: as many as 5 % of the time allow.",
    ),
]

Seed = Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of all random numbers.")]

AllowOutside = Annotated[
    bool,
    typer.Option(
        "--allow-outside",
        callback=confinement.allow,
        help="Allow a capture or a scene to read files outside its own folder.",
        show_default=False,
    ),
]
"""Option that takes effect when it is parsed, see `io.confinement`."""

NoCache = Annotated[
    bool,
    typer.Option("--no-cache", help="Render a gallery problem's references without the cache.", show_default=False),
]

WorkersOption = Annotated[
    str | None,
    typer.Option(
        metavar="auto | N | HOST:PORT",
        help="Run in Ray processes: one per GPU or core, N of them, or those of a cluster. Default: in this process.",
        show_default=False,
    ),
]

Insecure = Annotated[
    bool,
    typer.Option(
        "--insecure",
        help="With --workers: join a cluster that other users can enter. They can run programs as its user.",
        show_default=False,
    ),
]


def workers(text: str | None, insecure: bool = False) -> Workers | None:
    """Return the value of --workers and --insecure; None for this process, which also runs a single worker without an address.

    Raises `InputError` if --workers is invalid, or --insecure is given without it.
    """
    if text is None:
        if insecure:
            raise InputError("--insecure: requires --workers HOST:PORT")
        return None
    from dataclasses import replace

    from unrender.app.distributed.cluster import Workers, load_ray

    parsed = Workers.parse(text)
    if parsed == Workers(1):
        return None
    load_ray()  # report missing packages before slow operations
    return replace(parsed, insecure=insecure)


def settings(pairs: Iterable[str] | None, option: str) -> dict[str, str]:
    """Return ["spp=4"] as {"spp": "4"}. Raise `InputError` for an invalid NAME=VALUE, or a repeated name."""
    result: dict[str, str] = {}
    for pair in pairs or ():
        name, equals, value = (part.strip() for part in pair.partition("="))
        if not equals or not name:
            raise InputError(f"{option} {pair}: expected NAME=VALUE")
        if name in result:
            raise InputError(f"{option} {pair}: {name} is set twice")
        result[name] = value
    return result


def literal(text: str) -> Any:
    """Return the integer, the number or the boolean that `text` represents; the text itself if it represents none."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return {"true": True, "false": False}.get(text.lower(), text)


def typed_options(context: typer.Context, accepted: Collection[str] = ()) -> list[str]:
    """Return the typed options of a command, such as "--seed", without those whose parameters are `accepted`."""
    options = [one for one in context.command.params if one.param_type_name == "option" and one.name not in accepted]
    sources = {one.opts[0]: context.get_parameter_source(one.name or "") for one in options}
    return [name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]


def check_variant(name: str) -> None:
    """Raise `InputError` for a variant that does not exist."""
    known = ("auto", *variant.VARIANTS)
    if name not in known:
        raise InputError(f"--variant {name}: expected {', '.join(known)}{did_you_mean(name, known)}")


def use_variant(name: str, threads: int | None = None) -> str:
    """Choose the variant and, on the processor, the number of threads (None for one per core), before anything is rendered.

    An unknown name raises `InputError`; one that this machine does not support raises `VariantError`.
    """
    check_variant(name)
    with phases.phase("loading"):
        chosen = variant.use(name)
        if threads is not None:
            variant.use_threads(threads)
    return chosen


def is_gallery(name: str) -> bool:
    """Return whether a gallery problem has this name."""
    return name in registry.names("gallery problem")


def check_file(name: str, options: Mapping[str, str] = MappingProxyType({})) -> None:
    """Raise `InputError` for an unknown name, for options that a gallery problem lacks, or for a problem file, not one of stages, that is
    missing or has invalid fields, before the slow imports."""
    _check_known(name)
    if options and is_gallery(name):
        gallery.check(name, {key: literal(value) for key, value in options.items()})
    file = Path(name)
    if file.suffix.lower() != ".toml":
        return
    if not file.exists():
        raise InputError(f"{name}: {bounded_files.no_file(file)}")
    if not is_stages(name):
        toml_file.check(file)


def check_problem(name: str, options: Mapping[str, str], cached: bool = True) -> None:
    """Raise `InputError` if `open_problem` would fail for reasons that can be checked without Mitsuba, or --no-cache has no effect.

    `cached` is False if --no-cache was typed.
    """
    _check_known(name)
    if _is_file(name):
        if Path(name).suffix.lower() not in ("", ".toml", ".xml"):
            raise InputError(f"{name}: expected a problem file, whose name ends in .toml")
        if Path(name).suffix.lower() == ".xml":
            raise InputError(
                f"{name}: a scene does not define the unknowns; write a problem file with: "
                f'scene = "{Path(name).name}", [[parameters]] and [[views]]'
            )
        if options:
            raise InputError(f"--problem-set {next(iter(options))}: only gallery problems have options; edit {name}")
        if not cached:
            raise InputError("--no-cache: only the references of gallery problems are cached; leave it out")
        if not Path(name).exists():
            raise InputError(f"{name}: {bounded_files.no_file(Path(name))}")
        refuse_stages(name)


def _check_known(name: str) -> None:
    if (_is_file(name) and not Path(name).is_dir()) or is_gallery(name):
        return
    if Path(name).is_dir():
        raise InputError(f"{name}: a folder, expected a problem file{_in_folder(Path(name))}")
    known = registry.names("gallery problem")
    file = f"; did you mean {name}.toml?" if Path(f"{name}.toml").is_file() else ""
    hint = file or did_you_mean(name, known) or f" ({', '.join(known)})"
    raise InputError(f"no problem {name}: neither a TOML file nor in the gallery{hint}")


def _in_folder(folder: Path) -> str:
    """Return a hint at what a folder that was typed in place of a problem can be used for; "" if there is none."""
    if (folder / "run.json").is_file():
        return f"; it is a run folder: `unrender resume {folder}` continues it, `unrender report {folder}` shows it"
    files = sorted(folder.glob("*.toml"))
    return f"; did you mean {files[0]}?" if len(files) == 1 else ""


def is_stages(name: str) -> bool:
    """Return whether the argument PROBLEM is a file of stages."""
    return Path(name).suffix.lower() in ("", ".toml") and Path(name).is_file() and stages_file.is_stages(Path(name))


def refuse_stages(file: str) -> None:
    """Raise `InputError` for a file of stages if a problem file is expected."""
    if is_stages(file):
        raise InputError(f"{file}: a file of stages, which only `unrender run` accepts; expected a problem file")


def open_problem(name: str, options: Mapping[str, str], cached: bool = True) -> Problem:
    """Open the problem of a TOML file or of the gallery, its references `cached` or not. A variant must be active. Raise `InputError`."""
    with phases.phase("loading"), contextlib.nullcontext() if cached else cache.bypassed():
        from unrender.scene.problem import Problem

        check_problem(name, options)
        if _is_file(name):
            return Problem.from_file(name)
        made = gallery.problem(name, **{key: literal(value) for key, value in options.items()})
        if not Path(f"{name}.toml").is_file():
            return made
        notice = f"{name} is the gallery's problem; the file in this folder is {name}.toml"
        return made.with_parts(notices=[*made.notices, notice])


def short_name(problem: str) -> str:
    """Return the base name of folders: the problem's name, or its file's without the extension."""
    return Path(problem).stem if problem.endswith(".toml") else problem


def absolute(problem: str) -> str:
    """Return the typed problem: the absolute path of a file, or the name of a gallery problem."""
    return str(Path(problem).absolute()) if _is_file(problem) else problem


def _is_file(name: str) -> bool:
    return Path(name).suffix.lower() in (".toml", ".xml") or bounded_files.kind(Path(name)) == "file"


def budget(steps: int | None, seconds: float | None) -> tuple[int | None, float | None]:
    """Return steps and seconds; `DEFAULT_STEPS` steps if both are None. Raise `InputError` for an invalid value."""
    if steps is not None and not (isinstance(steps, Integral) and 1 <= steps < 1 << 63):
        raise InputError(f"--steps {in_words(steps)}: expected at least 1 and less than 2**63")
    if seconds is not None and not 0 < checks.real(seconds) < math.inf:
        raise InputError(f"--seconds {in_words(seconds).removesuffix('.0')}: expected a number above 0")
    return (DEFAULT_STEPS if steps is None and seconds is None else steps), seconds


def folder(out: Path | None, default: str, overwrite: bool, *marks: str) -> Path:
    """Return the output folder, created now so that an invalid location is reported before hours of work.

    Args:
        out: folder that the user chose, or None for a new folder in out/.
        default: its name there; a number is appended if it exists.
        overwrite: whether a folder with earlier results may be written to.
        marks: patterns of files that identify earlier results.

    Raises:
        InputError: `out` is a file, has other contents, has earlier results without `overwrite`, or cannot be written to.
    """
    if out is None:
        name = re.sub(r"[^\w.-]+", "-", default).strip(".-") or "run"
        number = 1
        out = Path("out", name)
        while out.exists():
            number += 1
            out = Path("out", f"{name}-{number}")
    with files.input_errors(f"--out {out}"):
        if out.exists() and not out.is_dir():
            raise InputError(f"--out {out}: a file, expected a folder")
        if out.is_dir() and any(not path.is_dir() for path in out.rglob("*")):
            if not any(True for mark in marks for _ in out.glob(mark)):
                raise InputError(f"--out {out}: the folder is not empty and holds no earlier results ({marks[0]})")
            if not overwrite:
                raise InputError(f"--out {out}: contains earlier results; give --overwrite to replace them")
        files.make_folder(out)
    if not os.access(out, os.W_OK | os.X_OK):
        raise InputError(f"--out {out}: not writable")
    return out


def command_line(context: typer.Context) -> str:
    """Return what the user typed, quoted for a shell."""
    _, words = context.find_root().obj or (None, ["unrender"])
    return shlex.join(words)


def began(context: typer.Context) -> float | None:
    """Return when the process began to start the command, on the clock of `time.perf_counter`; None if unknown."""
    return (context.find_root().obj or (None, ()))[0]


def check_folder(directory: Path) -> None:
    """Raise `InputError` for a run folder that does not exist, before the slow imports."""
    if not directory.is_dir():
        what = "a file, expected a run folder" if directory.exists() else "no such run folder"
        raise InputError(f"{directory}: {what}")


def finished_run(directory: Path) -> Path:
    """Return the folder itself or, for a run in stages, the run folder of the last stage that has started. Raise `InputError`."""
    return stages_file.last_result(directory)


def remove_if_empty(directory: Path) -> None:
    """Remove an empty folder that `folder` created, and an empty out/ above it."""
    with contextlib.suppress(OSError):
        directory.rmdir()
        if directory.parent == Path("out"):
            directory.parent.rmdir()
