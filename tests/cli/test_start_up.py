"""What a command imports before it says its first word."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import unrender

PROGRAM = """
import sys
from unrender.app.cli.main import main
for arguments in {lines!r}:
    assert main(arguments.split()) == 0
print(*sorted({{name.partition(".")[0] for name in sys.modules}}))
"""
WHEN_NEEDED = """
import sys
import unrender.app.cli.execute, unrender.runs.live
from unrender import gallery
from unrender.methods import methods
gallery.names(), methods()
print(*sorted(sys.modules))
"""


COMPLAINT = """
import sys
from unrender.app.cli.main import main
for words in {lines!r}:
    assert main(words) == 2
print(*sorted(sys.modules))
"""


BEGAN = """
import sys, time
before = time.perf_counter()
while time.perf_counter() - before < 0.3:
    pass
sys.argv[1:] = ["run", "wall"]
from unrender.app.cli import app, main
app.app = lambda *words, obj, **options: print(obj[0] < before, end="")
main.main()
"""


def imported(code: str) -> set[str]:
    environment = {**os.environ, "PYTHONPATH": str(Path(unrender.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    return set(done.stdout.splitlines()[-1].split())


def test_the_version_costs_no_imports() -> None:
    assert not imported(PROGRAM.format(lines=["--version"])) & {
        "numpy",
        "mitsuba",
        "drjit",
        "typer",
        "rich",
        "pydantic",
    }


def test_help_costs_few_imports() -> None:
    assert not imported(PROGRAM.format(lines=["--help", "run --help"])) & {
        "numpy",
        "mitsuba",
        "drjit",
        "scipy",
        "matplotlib",
        "PIL",
        "jinja2",
    }


@pytest.mark.slow
def test_a_run_imports_what_its_end_needs_at_its_end() -> None:
    needed = imported(WHEN_NEEDED)
    late = {
        "matplotlib",
        "scipy.stats",
        "scipy.optimize",
        "scipy.fft",
        "skimage",
        "jinja2",
        "uvicorn",
        "unrender.app.report",
    }
    assert not needed & late


def test_a_bad_problem_or_name_is_told_before_what_takes_long_to_import(tmp_path: Path) -> None:
    """An unknown name took 1.4 s of processor time: methods, gallery and Mitsuba were imported first."""
    files = [tmp_path / name for name in ("none.toml", "number.toml", "scene.toml", "syntax.toml", "field.toml")]
    files[1].write_text("max_depth = 1.5\n")
    files[2].write_text('scene = "none.xml"\n[[parameters]]\n[[views]]\n')
    files[3].write_text("[[parameters]\n")
    files[4].write_text('scene = "none.xml"\n[[parameters]]\nbounds = 3\n[[views]]\nreference = "a.exr"\n')
    late = {
        "unrender.estimators.base",
        "unrender.runs.optimize",
        "unrender.gallery",
        "mitsuba",
        "drjit",
        "scipy.special",
    }
    lines = [["run", str(file)] for file in files]
    lines += [
        words.split() for words in ("run none", "run wall --method none", "compare none", "compare wall --methods none")
    ]
    # An option and a field of the file had taken 1.1 and 0.9 s, of Dr.Jit and most of the library.
    lines += [["run", "wall", *words.split()] for words in ("--set spp=x", "--set none=1", "--variant none")]
    lines += [words.split() for words in ("sweep none", "methods none", "methods --plan none", "gallery none")]
    lines += [[command, str(tmp_path / "none")] for command in ("resume", "report", "judge", "turntable")]
    assert not imported(COMPLAINT.format(lines=lines)) & late


@pytest.mark.skipif(not Path("/proc/thread-self/schedstat").exists(), reason="needs Linux")
def test_the_budget_of_a_command_begins_with_its_process() -> None:
    """On a loaded machine, 2 to 4 s of imports came before it."""
    assert imported(BEGAN) == {"True"}


def test_a_command_has_one_thread_of_blas_unless_told() -> None:
    """Beside busy processes, small least-squares systems took a hundred times as long with two, which wait for one another."""
    show = "(os.environ['OPENBLAS_NUM_THREADS'], 'numpy' in sys.modules)"  # NumPy reads it when it is imported
    script = f"import os, sys; from unrender.app.cli import main as m; m._command = lambda *_: lambda: print({show}); m.main()"
    for given, expected in ({"OPENBLAS_NUM_THREADS": "3"}, "3"), ({}, "1"):
        environment = {k: x for k, x in os.environ.items() if k != "OPENBLAS_NUM_THREADS"} | given
        done = subprocess.run(
            [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
        )
        assert done.stdout.split("\n")[0] == f"('{expected}', False)"
