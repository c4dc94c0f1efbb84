"""Ctrl-C and SIGTERM at any moment from the command's start to its end: one line, an exit status, nothing half written.

`UNRENDER_SIGNALS=100 pytest tests/cli/test_signals_anywhere.py -m slow` draws more moments.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from tiers import slow
from unrender.app.cli import signals as handled
from unrender.core.errors import InputError
from unrender.runs.folder import reader

COUNT = int(os.environ.get("UNRENDER_SIGNALS", "10"))
WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
RUN = [
    "run",
    "exponential",
    "--method",
    "plain",
    "--steps",
    "100",
    "--checkpoint-every",
    "20",
    "--final-spp",
    "64",
    "--out",
    "run",
]
COMMAND = "import sys; sys.argv[0] = 'unrender'; import unrender; print('loading', file=sys.stderr, flush=True); "
COMMAND += "from unrender.app.cli.main import main; sys.exit(main())"
"""As the command's script, and it tells when the package is there: until then, what happens is Python's own affair."""

ENVIRONMENT = {**os.environ, "RAY_worker_niceness": "0"}
"""Ray's own niceness would starve its workers on a busy machine."""


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    folder.mkdir()
    line = [sys.executable, "-c", COMMAND, *words]
    return subprocess.Popen(
        line, cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def ended(process: subprocess.Popen[str], number: signal.Signals) -> float:
    """Send a signal to a command that was started, and hold it to its end; return the seconds that this took."""
    process.send_signal(number)
    before = time.monotonic()
    _, said = process.communicate(timeout=60)
    seconds = time.monotonic() - before
    if process.returncode == 0:  # it came too late
        assert said == ""
    else:
        waited = f"unrender: {handled.WAITING}\n"
        assert (process.returncode, said.removeprefix(waited)) == (128 + number, f"unrender: {WORDS[number]}\n")
    return seconds


def await_package(process: subprocess.Popen[str]) -> None:
    assert process.stderr is not None
    assert process.stderr.readline() == "loading\n"


@pytest.mark.parametrize(("number", "moments"), [(signal.SIGINT, (0.0, 0.25)), slow(signal.SIGTERM, (0.1, 0.4))])
def test_while_the_command_is_loaded(tmp_path: Path, number: signal.Signals, moments: tuple[float, ...]) -> None:
    for n, moment in enumerate(moments):
        process = start(tmp_path / str(n), "methods", "rcv")
        await_package(process)
        time.sleep(moment)
        ended(process, number)


@pytest.mark.slow
def test_an_import_that_never_ends_is_interrupted_all_the_same(tmp_path: Path) -> None:
    (tmp_path / "endless_module.py").write_text("import time\nwhile True: time.sleep(0.02)\n")
    code = textwrap.dedent("""
        import os, signal, sys, threading
        sys.path.insert(0, sys.argv[1])
        from unrender.app.cli.signals import Signals
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM)).start()
        with Signals(process=True):
            import endless_module
    """)
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (143, "unrender: terminated\n")


@pytest.mark.parametrize("again", [slow(False), True])
def test_compiled_code_that_goes_on_says_why_nothing_happens(tmp_path: Path, again: bool) -> None:
    """The first signal is acknowledged though no handler can run, and the second ends the process."""
    code = textwrap.dedent("""
        import hashlib, os, signal, sys, threading, time
        from unrender.app.cli import signals
        signals._SILENT = signals._STUCK = 0.2
        rounds, again = int(sys.argv[1]), sys.argv[2] == "True"
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        if again:
            threading.Timer(1.5, os.kill, (os.getpid(), signal.SIGTERM)).start()
        try:
            with signals.Signals(process=True) as handled:
                hashlib.pbkdf2_hmac("sha256", b"", b"", rounds)
        except KeyboardInterrupt:
            print("interrupted", handled.status)
    """)
    rounds = 2_000_000_000 if again else 6_000_000
    words = [sys.executable, "-c", code, str(rounds), str(again)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    waiting = f"unrender: {handled.WAITING}\n"
    if again:
        assert (done.returncode, done.stderr) == (143, waiting + "unrender: terminated\n")
    else:
        assert (done.stdout, done.stderr) == ("interrupted 130\n", waiting)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(5))
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_at_uniformly_drawn_moments(tmp_path: Path, number: signal.Signals, part: int) -> None:
    begun = time.monotonic()
    process = start(tmp_path / "undisturbed", *RUN)
    await_package(process)
    process.communicate(timeout=120)
    whole = time.monotonic() - begun
    draw = random.Random(100 * int(number) + part)
    for n in range(-(-COUNT // 5)):
        folder = tmp_path / str(n)
        process = start(folder, *RUN)
        await_package(process)
        time.sleep(draw.uniform(0, whole))
        ended(process, number)
        if (folder / "run" / "run.json").exists():
            reader.read(folder / "run")
        else:
            with pytest.raises(InputError):
                reader.read(folder / "run")


def test_an_interrupt_waits_for_the_end_of_an_import(tmp_path: Path) -> None:
    """Compiled code that imports modules aborts at an exception in them."""
    (tmp_path / "slow_module.py").write_text(
        "import time\nfor _ in range(20): time.sleep(0.02)\nprint('whole', flush=True)\n"
    )
    code = textwrap.dedent("""
        import os, signal, sys, threading, time
        sys.path.insert(0, sys.argv[1])
        from unrender.app.cli.signals import Signals
        signals = Signals(process=True)
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
        try:
            with signals:
                import slow_module
                time.sleep(10)
        except KeyboardInterrupt:
            print("interrupted", signals.status)
    """)
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("whole\ninterrupted 130\n", "")


def test_a_program_that_imports_the_package_keeps_its_handlers() -> None:
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); import unrender; "
    code += "print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"
    assert handled.WORDS[130] == "interrupted"
