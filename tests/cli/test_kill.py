"""Runs killed at random instants, while they write too, end where they would have ended."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from victim import CASES

import unrender as package
from unrender.app.cli.signals import DOUBTFUL
from unrender.runs.folder import checkpoint
from unrender.runs.folder import reader as report_folder
from unrender.runs.folder.checkpoint import STATE
from unrender.runs.folder.schema import MEMORY_DISAGREES, WORSE

SOURCE = str(Path(package.__file__).parents[1])
ENVIRONMENT = {**os.environ, "PYTHONPATH": SOURCE}
TINY = ["-p", "resolution=8", "-p", "texture_resolution=4", "-p", "reference_spp=8"]
COMMANDS = {
    "auto": ["indirect-room", *TINY],
    "plain": ["indirect-room", *TINY, "--method", "plain", "--set", "spp=2"],
    "rcv": ["indirect-room", *TINY, "--method", "rcv"],
    "rcv, primary": [
        "lamp",
        "--method",
        "rcv",
        "-p",
        "resolution=8",
        "-p",
        "reference_spp=8",
        "--set",
        "space=primary",
    ],
    "adaptive": ["indirect-room", *TINY, "--method", "adaptive", "--set", "pixels=32", "--set", "refresh=7"],
    "meta": ["indirect-room", *TINY, "--method", "meta"],
    "coupled, rcv": ["indirect-room", *TINY, "--method", "coupled", "--set", "image=rcv"],
    "smoothed": ["box2", "-p", "resolution=8", "-p", "reference_spp=8", "--method", "smoothed", "--set", "samples=4"],
}
COMMAND_STEPS = 40
ENDED = (0, DOUBTFUL)  # so few samples may well end with a picture worse than the initial one


class Killer:
    """Starts runs in children of one process and kills them."""

    def __init__(self) -> None:
        victim = Path(__file__).with_name("victim.py")
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen([sys.executable, str(victim)], env=ENVIRONMENT, **pipes)

    def live(self, case: str, folder: Path, every: int, after: float | None = None) -> int:
        """Let a run live, for `after` seconds or to its end. Returns its exit status, -9 where it was killed."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{case} {folder} {every}\n")
        self._process.stdin.flush()
        child = int(self._process.stdout.readline())
        if after is not None:
            time.sleep(after)
            os.kill(child, signal.SIGKILL)
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def close(self) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(timeout=60)
        self._process.stdout.close()


@pytest.fixture(scope="module")
def killer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Killer]:
    made = Killer()
    made.live(next(iter(CASES)), tmp_path_factory.mktemp("first"), 3)  # imports, which other runs find done
    yield made
    made.close()


def states(folder: Path) -> dict[str, bytes]:
    """Every number of the last checkpoint: parameters and the states of estimator and optimizer."""
    last = max((folder / checkpoint.FOLDER).glob("[0-9]*"))
    return {last.name: (last / STATE).read_bytes()}


def check_readable(folder: Path) -> None:
    """A run that has begun can be read, whatever it died of; one that has not can be begun."""
    if (folder / "run.json").exists():
        next(checkpoint.candidates(folder))
        report_folder.read(folder)


def kill_analytic(killer: Killer, tmp_path: Path, case: str, seed: int) -> None:
    """Kill a case at least once in the first, the second and the last third of its run."""
    dice, whole = random.Random(f"{case} {seed}"), tmp_path / "whole"
    started = time.perf_counter()
    assert killer.live(case, whole, 3) == 0
    seconds = time.perf_counter() - started
    tried = 0
    for third in range(3):
        died = False
        while not died:
            tried += 1
            assert tried < 20
            folder, every = tmp_path / str(tried), dice.choice((1, 1, 2, 5))
            while killer.live(case, folder, every, (third + dice.random()) / 3 * seconds) == -signal.SIGKILL:
                died = True  # and once more, while it is resumed, now and then
                check_readable(folder)
                if dice.random() < 0.6:
                    assert killer.live(case, folder, every) == 0, tried
                    break
            assert states(folder) == states(whole), tried
            assert not list(folder.rglob("*.part"))
            seconds *= 1.0 if died else 0.8  # it takes less time than measured


def command(*words: object) -> subprocess.Popen[str]:
    line = [sys.executable, "-m", "unrender", *map(str, words)]
    return subprocess.Popen(line, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process: subprocess.Popen[str]) -> int:
    said, _ = process.communicate(timeout=300)
    assert process.returncode in (*ENDED, -signal.SIGKILL), said
    return process.returncode


def wait_for_steps(process: subprocess.Popen[str], folder: Path, steps: int) -> None:
    """Until the run has come so far, however fast the machine is; below 0, until its folder is there; or until it has ended."""
    history = folder / "history.jsonl"
    while process.poll() is None:
        if folder.exists() and (steps < 0 or (history.exists() and history.read_bytes().count(b"\n") >= steps)):
            return
        time.sleep(0.005)


def kill_command(tmp_path: Path, name: str, seed: int) -> None:
    """Kill a command in the first half of its steps, resume it, and kill it again in the second half."""
    dice = random.Random(f"{name} {seed}")
    words = [*COMMANDS[name], "--steps", COMMAND_STEPS, "--threads", 1, "--variant", "llvm_ad_rgb", "--final-spp", 1]
    whole = tmp_path / "whole"
    status = finish(command("run", *words, "--out", whole, "--checkpoint-every", 7))
    assert status in ENDED
    tried, killed = 0, False
    while not killed:
        tried += 1
        assert tried < 10
        folder = tmp_path / str(tried)
        begin = ["run", *words, "--out", folder, "--checkpoint-every"]
        line: list[object] = [*begin, dice.choice((1, 3))]
        for first, last in ((-3, COMMAND_STEPS // 2), (COMMAND_STEPS // 2, COMMAND_STEPS)):
            process = command(*line)
            wait_for_steps(process, folder, dice.randint(first, last))
            time.sleep(dice.uniform(0, 0.05))
            process.kill()
            ended = finish(process)
            if ended in ENDED:
                assert ended == status
                break
            check_readable(folder)
            begun = (folder / "run.json").exists()
            done = ("finished", WORSE, MEMORY_DISAGREES)
            if begun and json.loads((folder / "run.json").read_text())["status"] in done:
                break  # it died while it wrote its page, and is refused: there is nothing to go on with
            line = ["resume", folder] if begun else [*begin, 5, "--overwrite"]
        else:
            killed = True
    assert finish(command(*line)) == status, tried
    assert states(folder) == states(whole), tried


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_runs_are_killed(killer: Killer, case: str, tmp_path: Path) -> None:
    kill_analytic(killer, tmp_path, case, seed=3)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_commands_are_killed(name: str, tmp_path: Path) -> None:
    kill_command(tmp_path, name, seed=4)
