"""Lock of a run folder: one process at a time; a dead process holds nothing.

The file `lock` names the process and is locked (`flock`) while it lives. The kernel releases the lock when the process ends for any
reason. So a folder cannot stay locked after a crash, by a reused process id, or by a container that restarts with another host name. If
the file system does not lock, or locks within one machine only although others write to it, the name decides: process id and start time,
measured from the boot of the machine and thus independent of its clock.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import platform
import re
import subprocess
from dataclasses import asdict, dataclass
from pathlib import Path

from unrender.core.errors import InputError
from unrender.io import bounded_files, files
from unrender.runs.folder.schema import LOCK

_LARGEST = 1 << 12
_MOUNTS = Path("/proc/self/mountinfo")
_SERVER = re.compile(r"nfs4?$|cifs$|smb3$")
_SHARED = re.compile(
    r"nfs|cifs|smb|9p|afs|ceph|lustre|gpfs|beegfs|ocfs2|gfs2|orangefs|pvfs2|glusterfs|virtiofs|fuse(?!blk)|vboxsf|prl_fs"
)
"""File systems that several machines may write to."""
_WITHIN_ONE_MACHINE = {"nolock", "local_lock=flock", "local_lock=all", "nobrl"}
"""Mount options with which these do not forward locks to the server."""


@dataclass(frozen=True)
class Holder:
    """A process of a machine; boot id and start time distinguish it from another process with the same id."""

    pid: int
    host: str
    started: str

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}"

    def is_gone(self) -> bool:
        """Return whether the process is known to have ended; never for a process of another machine."""
        return self.host == platform.node() and _started(self.pid) != self.started


class Lock:
    """Lock of an existing run folder, from `acquire` to `release`."""

    def __init__(self, folder: Path):
        self.path = folder / LOCK
        self._file: int | None = None

    def acquire(self) -> None:
        """Acquire the lock. Raises `InputError` if another process holds it, or it cannot be taken, with the holder or the reason."""
        with files.input_errors(f"run folder {self.path.parent}: cannot be locked"):
            while self._file is None:
                self._file = self._try()

    def is_held(self) -> bool:
        """Return whether the folder still has this lock: it may have been deleted, and locked by another process."""
        if self._file is None:
            return False
        with contextlib.suppress(OSError):
            return os.path.samestat(os.stat(self.path), os.fstat(self._file))
        return False

    def release(self) -> None:
        """Release the lock. Does nothing if it is not held."""
        if self._file is None:
            return
        try:
            with contextlib.suppress(OSError):
                if self.is_held():
                    self.path.unlink()
        finally:
            os.close(self._file)
            self._file = None

    def _try(self) -> int | None:
        """Return the locked file; None if it was deleted in between, so that the caller tries again."""
        file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        locked = False
        try:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                locked = True
            except BlockingIOError:
                raise InputError(self._in_use(_read(self.path))) from None
            except OSError:
                pass  # the file system does not lock, so the name decides
            if not os.path.exists(self.path) or not os.path.samestat(os.stat(self.path), os.fstat(file)):
                os.close(file)
                return None
            known = _read(self.path)
            decided = locked and (_locks_for_all(file) or (known is not None and known.host == platform.node()))
            if known is not None and not known.is_gone() and not decided:
                raise InputError(self._in_use(known))
            me = Holder(os.getpid(), platform.node(), _started(os.getpid()))
            os.ftruncate(file, 0)
            os.pwrite(file, (json.dumps(asdict(me)) + "\n").encode(), 0)
            return file
        except BaseException:
            with contextlib.suppress(OSError):
                os.close(file)
            raise

    def _in_use(self, holder: Holder | None) -> str:
        who = "another process" if holder is None else str(holder)
        elsewhere = holder is not None and holder.host != platform.node()
        hint = f"; if that is no more, delete {self.path}" if elsewhere else ""
        return f"run folder {self.path.parent}: in use by {who}{hint}"


def holder(folder: Path) -> Holder | None:
    """Return the process that holds a run folder, as far as known without acquiring it; None if there is none or it has ended."""
    known = _read(folder / LOCK)
    return None if known is None or known.is_gone() or _is_free(folder / LOCK) else known


def _is_free(path: Path) -> bool:
    """Return whether the lock is known to be held by no process of any machine."""
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return _locks_for_all(file)
    except OSError:
        return False
    finally:
        os.close(file)


def _locks_for_all(file: int) -> bool:
    """Return whether a lock of this file excludes every process of every machine.

    On a local file system, all processes use one kernel. NFS and SMB forward locks to the server unless mounted otherwise. Nothing is
    known about other shared file systems.
    """
    device = os.fstat(file).st_dev
    number = f"{os.major(device)}:{os.minor(device)}"
    try:
        mounts = [line.split(" - ") for line in _MOUNTS.read_text().splitlines()]
    except OSError:
        return False  # not Linux: the file system is unknown
    for mount, described in (parts for parts in mounts if len(parts) == 2):
        if mount.split()[2] == number:
            kind, _, options = described.split(" ", 2)
            return not _SHARED.match(kind) or (
                bool(_SERVER.match(kind)) and _WITHIN_ONE_MACHINE.isdisjoint(options.split(","))
            )
    return True  # btrfs and overlays use device numbers without a mount; shared file systems have their own


def _read(path: Path) -> Holder | None:
    try:
        content = bounded_files.parse_json(bounded_files.read_bytes(path, _LARGEST), str(path))
        match content:
            case {"pid": int(pid), "host": str(host), "started": str(started)} if 0 < pid < 1 << 31:
                return Holder(pid, host[:200], started)
    except InputError:
        pass  # missing, or not written by a run
    return None


def _started(pid: int) -> str:
    """Return the start time of a process of this machine; "" if there is none with this id."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        # The name, in parentheses, may contain anything. The 22nd field is the start in ticks since boot.
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return "" if fields[0] == "Z" else f"{boot}/{fields[19]}"
    except (OSError, IndexError):
        if Path("/proc/self/stat").exists():
            return ""
    with contextlib.suppress(OSError):
        answer = subprocess.run(
            ["ps", "-o", "lstart=", "-p", str(pid)], capture_output=True, text=True, check=False, env={"LC_ALL": "C"}
        )
        return answer.stdout.strip()
    return ""
