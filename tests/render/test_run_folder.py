"""Run folders while their runs go: what goes wrong with them is one line, and nothing that was written is lost."""

from __future__ import annotations

import errno
import json
import os
import platform
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from callbacks import At, of_the_run

import unrender as ur
from unrender.core.errors import InputError
from unrender.io import files
from unrender.runs.folder import checkpoint, lock, reader
from unrender.runs.folder.lock import Holder, Lock

RATE = "rate"


def start(folder: Path, steps: int = 12, every: int | None = 2, callbacks: Any = (), **options: Any) -> ur.Result:
    """A run without a renderer."""
    problem = ur.gallery.problem("exponential")
    optimizer = ur.optimizers.Adam(0.05)
    return ur.optimize(
        problem, ur.PathGradient(spp=2), optimizer, steps, None, 0, callbacks, folder, checkpoint_every=every, **options
    )


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / checkpoint.FOLDER).iterdir())


def status(folder: Path) -> str:
    return json.loads((folder / "run.json").read_text())["status"]


def steps_of(folder: Path) -> list[int]:
    return [json.loads(line)["step"] for line in (folder / "history.jsonl").read_text().splitlines()]


def plain(steps: int = 12) -> ur.Result:
    return ur.optimize(ur.gallery.problem("exponential"), ur.PathGradient(spp=2), ur.optimizers.Adam(0.05), steps)


# ---------------------------------------------------------------------- as it should be


def test_the_folder_is_whole_at_every_step(tmp_path: Path) -> None:
    folder = tmp_path / "run"

    def look(run: Any) -> None:
        assert run.folder == folder
        assert status(folder) == "running"
        assert steps_of(folder) == list(range(run.step))
        assert lock.holder(folder) == Holder(os.getpid(), platform.node(), lock._started(os.getpid()))
        assert names(folder) == [f"{step:08d}" for step in range(2, run.step + 1, 2)][-3:]

    start(folder, callbacks=[At(step, look) for step in range(2, 13)])
    assert status(folder) == "finished"
    assert lock.holder(folder) is None
    assert names(folder) == ["00000008", "00000010", "00000012"]
    assert not (folder / "lock").exists()
    record = json.loads((folder / "run.json").read_text())
    assert record["steps"] == 12
    assert record["problem"]["origin"] == {"gallery": "exponential", "options": {}}


def test_a_checkpoint_now_and_then_by_default(tmp_path: Path) -> None:
    start(tmp_path / "run", steps=120, every=None)
    found = [int(name) for name in names(tmp_path / "run")]
    assert found[-1] == 120
    assert all(step % 50 == 0 for step in found[:-1])


def test_an_earlier_run_in_the_folder_is_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    start(folder)
    (folder / "notes.txt").write_text("mine")
    (folder / "live").mkdir()
    start(folder, steps=3)
    assert names(folder) == ["00000002", "00000003"]
    assert (folder / "notes.txt").read_text() == "mine"
    assert not (folder / "live").exists()


def test_a_folder_of_something_else_keeps_what_it_had(tmp_path: Path) -> None:
    (tmp_path / "live").mkdir()
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "mine").write_text("mine")
    start(tmp_path, steps=3)
    assert (tmp_path / "live").is_dir()
    assert (tmp_path / "checkpoints" / "mine").read_text() == "mine"


def test_ctrl_c_writes_a_checkpoint(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    start(folder, every=100, callbacks=[At(5, lambda run: signal.raise_signal(signal.SIGINT))])
    assert (names(folder), status(folder)) == (["00000005"], "interrupted")
    assert ur.resume(folder).parameters[RATE] == plain().parameters[RATE]
    assert status(folder) == "finished"


def test_an_error_in_a_callback_is_kept(tmp_path: Path) -> None:
    folder = tmp_path / "run"

    def fail(run: Any) -> None:
        raise ZeroDivisionError("by hand\nin two lines")

    with pytest.raises(ZeroDivisionError):
        start(folder, callbacks=[At(5, fail)])
    record = json.loads((folder / "run.json").read_text())
    assert (record["status"], record["error"]) == ("failed", "by hand in two lines")
    assert ur.resume(folder).parameters[RATE] == plain().parameters[RATE]


# ---------------------------------------------------------------------- no room, no right


def _full(*_: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_costs_checkpoints_and_not_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Full from step 5 to step 9: earlier checkpoints stay, the history is made up for."""
    folder = tmp_path / "run"
    write = os.pwrite

    def fill(run: Any) -> None:
        monkeypatch.setattr(os, "fsync", _full)
        monkeypatch.setattr(os, "pwrite", _full)

    def empty(run: Any) -> None:
        assert names(folder) == ["00000002", "00000004"]
        assert steps_of(folder) == list(range(5))
        monkeypatch.undo()
        assert os.pwrite is write

    result = start(folder, callbacks=[At(5, fill), At(9, empty)])
    assert [line for line in result.warnings if "checkpoint" in line] == [
        f"run folder {folder}: checkpoint not written: No space left on device; the run continues"
    ]
    assert len([line for line in result.warnings if "history" in line]) == 1
    assert steps_of(folder) == list(range(12))
    assert names(folder) == ["00000004", "00000010", "00000012"]
    assert result.parameters[RATE] == plain().parameters[RATE]


def test_a_disk_that_stays_full_is_one_error_in_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "run"

    def fill(run: Any) -> None:
        monkeypatch.setattr(os, "fsync", _full)
        monkeypatch.setattr(files, "write", _write_nothing)

    with pytest.raises(InputError, match="No space left on device"):
        start(folder, callbacks=[At(5, fill)])
    monkeypatch.undo()
    assert names(folder) == ["00000002", "00000004"]
    assert ur.resume(folder).parameters[RATE] == plain().parameters[RATE]


def _write_nothing(path: Path, data: bytes, durable: bool = True, name_too: bool = True) -> Path:
    raise InputError(f"{path}: cannot be written: {os.strerror(errno.ENOSPC)}")


def test_a_real_limit_on_files(tmp_path: Path) -> None:
    """The kernel refuses to let any file grow beyond some bytes, in the middle of a line and of a checkpoint."""
    folder = tmp_path / "run"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    def fill(run: Any) -> None:
        size = (folder / "history.jsonl").stat().st_size
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 40, limits[1]))

    def empty(run: Any) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert steps_of(folder) == list(range(5))

    try:
        result = start(folder, callbacks=[At(5, fill), At(9, empty)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, ignored)
    assert any("File too large" in line for line in result.warnings)
    assert steps_of(folder) == list(range(12))
    assert result.parameters[RATE] == plain().parameters[RATE]


@pytest.mark.parametrize("error", [errno.EROFS, errno.EACCES])
def test_a_folder_that_cannot_be_written_is_refused_at_once(tmp_path: Path, monkeypatch, error: int) -> None:
    opened = os.open

    def refuse(path: Any, flags: int, *more: Any, **named: Any) -> int:
        if str(path).endswith("lock") and flags & os.O_CREAT:
            raise OSError(error, os.strerror(error))
        return opened(path, flags, *more, **named)

    folder = tmp_path / "run"
    start(folder)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(InputError, match=f"run folder .*: cannot be locked: {os.strerror(error)}"):
        ur.resume(folder, steps=20)
    with pytest.raises(InputError, match="cannot be locked"):
        start(folder)
    monkeypatch.undo()
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_file_in_the_folder_s_place_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("")
    with pytest.raises(InputError, match=r"run folder .*run: File exists"):
        start(tmp_path / "run")


def test_a_folder_deleted_on_the_way_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unrender.runs.folder.writer._CHECK_SECONDS", 0.0)
    folder = tmp_path / "run"
    result = start(folder, every=4, callbacks=[At(5, lambda run: shutil.rmtree(folder))])
    assert of_the_run(result.warnings) == [
        f"run folder {folder}: deleted during the run; it was created again, without the earlier checkpoints"
    ]
    assert steps_of(folder) == list(range(12))
    assert names(folder) == ["00000006", "00000008", "00000012"]
    assert status(folder) == "finished"
    assert ur.resume(folder, steps=20).parameters[RATE] == plain(20).parameters[RATE]


def test_a_folder_deleted_and_taken_by_another_is_left_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unrender.runs.folder.writer._CHECK_SECONDS", 0.0)
    folder = tmp_path / "run"
    other = Lock(folder)

    def take(run: Any) -> None:
        shutil.rmtree(folder)
        folder.mkdir()
        other.acquire()

    try:
        with pytest.raises(InputError, match="another run has taken its place; the result is not saved"):
            start(folder, callbacks=[At(5, take)])
        assert [path.name for path in folder.iterdir()] == ["lock"]
    finally:
        other.release()


# ---------------------------------------------------------------------- two runs, and clocks


def test_two_runs_in_one_folder(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    told: list[str] = []

    def again(run: Any) -> None:
        for other in (lambda: start(folder), lambda: ur.resume(folder, steps=40)):
            with pytest.raises(InputError) as caught:
                other()
            told.append(str(caught.value))

    result = start(folder, callbacks=[At(5, again)])
    assert told == [f"run folder {folder}: in use by process {os.getpid()} on {platform.node()}"] * 2
    assert steps_of(folder) == list(range(12))
    assert result.parameters[RATE] == plain().parameters[RATE]


def test_the_lock_of_a_process_that_died_is_no_lock(tmp_path: Path) -> None:
    code = "import sys, time; from pathlib import Path; from unrender.runs.folder.lock import Lock\n"
    code += "Lock(Path(sys.argv[1])).acquire(); print('held', flush=True); time.sleep(60)"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    words = [sys.executable, "-c", code, str(tmp_path)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        found = lock.holder(tmp_path)
        assert found is not None
        assert found.pid == process.pid
        with pytest.raises(InputError, match=f"in use by process {process.pid} on "):
            Lock(tmp_path).acquire()
    finally:
        process.kill()
        process.communicate()
    assert (tmp_path / "lock").exists()
    assert lock.holder(tmp_path) is None
    mine = Lock(tmp_path)
    mine.acquire()
    mine.release()
    assert not (tmp_path / "lock").exists()


def write_lock(folder: Path, **fields: Any) -> None:
    me = {"pid": os.getpid(), "host": platform.node(), "started": lock._started(os.getpid())}
    (folder / "lock").write_text(json.dumps({**me, **fields}))


def test_a_number_given_to_another_process_is_told_apart(tmp_path: Path) -> None:
    """This very process is alive, but did not start when the lock's did."""
    write_lock(tmp_path, started="another/1")
    assert lock.holder(tmp_path) is None
    mine = Lock(tmp_path)
    mine.acquire()
    mine.release()


def mounted(folder: Path, monkeypatch: pytest.MonkeyPatch, kind: str, options: str) -> None:
    """Let the folder's file system be one of another kind."""
    device = folder.stat().st_dev
    table = folder / "mounts"
    table.write_text(
        f"22 27 0:2 / /proc rw - proc proc rw\n36 27 {os.major(device)}:{os.minor(device)} / /data rw shared:1 - "
        f"{kind} server:/data rw,{options}\n"
    )
    monkeypatch.setattr(lock, "_MOUNTS", table)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("nfs4", "local_lock=all"),
        ("nfs", "nolock,local_lock=none"),
        ("cifs", "nobrl"),
        ("fuse.sshfs", "rw"),
        ("ceph", "rw"),
    ],
)
def test_the_lock_of_another_machine_is_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, options: str
) -> None:
    """Where it may be held though this machine's kernel knows of nobody."""
    mounted(tmp_path, monkeypatch, kind, options)
    write_lock(tmp_path, host="elsewhere", started="")
    assert lock.holder(tmp_path) is not None
    with pytest.raises(InputError, match=r"in use by process \d+ on elsewhere; if that is no more, delete .*lock"):
        Lock(tmp_path).acquire()
    assert (tmp_path / "lock").exists()


@pytest.mark.parametrize(("kind", "options"), [("ext4", "rw"), ("overlay", "rw"), ("nfs4", "vers=4.2,local_lock=none")])
def test_a_container_that_starts_again_finds_its_lock_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, options: str
) -> None:
    """Under another host name, with the same process number, on a file system whose locks exclude everybody."""
    folder = tmp_path / "run"
    start(folder, steps=6)
    mounted(folder, monkeypatch, kind, options)
    write_lock(folder, host="3f2a9c81d4e7", started="")
    assert lock.holder(folder) is None
    assert ur.resume(folder, steps=12).parameters[RATE] == plain().parameters[RATE]
    held = Lock(folder)
    held.acquire()
    write_lock(folder, host="3f2a9c81d4e7", started="")  # and one that is held is refused, whatever it says
    with pytest.raises(InputError, match="in use by process"):
        ur.resume(folder, steps=20)
    held.release()


def test_without_locks_in_the_file_system_the_name_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", refuse)
    write_lock(tmp_path)
    with pytest.raises(InputError, match="in use by process"):
        Lock(tmp_path).acquire()
    write_lock(tmp_path, started="another/1")
    Lock(tmp_path).acquire()


def test_a_clock_set_back_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a year, in the middle of a run and between run and resume."""
    folder = tmp_path / "run"
    now = time.time

    def back(run: Any) -> None:
        monkeypatch.setattr(time, "time", lambda: now() - 365 * 86400)
        for path in folder.rglob("*"):
            os.utime(path, (now() + 86400, now() + 86400))  # files of the future

    result = start(folder, steps=6, callbacks=[At(3, back)])
    assert not of_the_run(result.warnings)
    again = ur.resume(folder, steps=12)
    seconds = [record["seconds"] for record in again.history]
    assert seconds == sorted(seconds)
    assert again.parameters[RATE] == plain().parameters[RATE]
    assert names(folder)[-1] == "00000012"


def test_time_paused_in_a_callback_is_not_counted(tmp_path: Path) -> None:
    seen: list[float] = []

    def pause(run: Any) -> None:
        seen.append(run.clock)
        time.sleep(0.3)
        assert run.clock == seen[0]

    result = start(tmp_path / "run", callbacks=[At(5, pause)])
    assert result.seconds == pytest.approx(result.history[-1]["seconds"])
    assert [record["seconds"] for record in result.history][4] == seen[0]


def test_checkpoints_that_cannot_be_said_are_one_warning(tmp_path: Path) -> None:
    """An estimator of the user's own, whose state holds what no checkpoint knows."""

    class Own:
        provides = frozenset({"gradient"})

        def init(self, problem, parameters):
            return {"open": object()}

        def estimate(self, problem, parameters, state, key):
            found, _ = ur.PathGradient(spp=2).estimate(
                problem, parameters, ur.PathGradient().init(problem, parameters), key
            )
            return found, state

    folder = tmp_path / "run"
    result = ur.optimize(
        ur.gallery.problem("exponential"), Own(), ur.optimizers.Adam(), 6, run_directory=folder, checkpoint_every=2
    )
    (line,) = of_the_run(result.warnings)
    assert "checkpoint not written: a state is made of dataclasses, arrays and numbers, got object" in line
    assert np.isfinite(result.parameters[RATE])
    assert status(folder) == "finished"


def test_ctrl_c_while_the_folder_is_begun_leaves_nothing_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What has a method and no record is no run, and `--out` would refuse it."""
    written = files.write_arrays

    def interrupted(path: Path, *arguments: Any, **options: Any) -> None:
        written(path, *arguments, **options)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(files, "write_arrays", interrupted)
        with pytest.raises(KeyboardInterrupt):
            start(tmp_path / "run")
    assert not [path for path in (tmp_path / "run").rglob("*") if path.is_file()]
    assert start(tmp_path / "run").status == "finished"


def test_a_run_killed_while_its_folder_was_begun_says_so(tmp_path: Path) -> None:
    start(tmp_path / "run", steps=2)
    (tmp_path / "run" / "run.json").unlink()
    (tmp_path / "run" / "lock").touch()
    with pytest.raises(InputError, match="stopped before its first step; start it again with --overwrite"):
        reader.read_run_record(tmp_path / "run")


def test_what_result_save_wrote_says_what_it_lacks(tmp_path: Path) -> None:
    plain(2).save(tmp_path / "saved")
    with pytest.raises(InputError, match=r"method\.toml: no such file: Result\.save stores no resumable run"):
        ur.resume(tmp_path / "saved")
    with pytest.raises(InputError, match=r"problem\.toml: no such file: Result\.save stores no problem; pass it"):
        ur.app.export(tmp_path / "saved", tmp_path / "scene")
