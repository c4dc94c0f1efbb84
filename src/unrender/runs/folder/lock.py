"""Who holds a run folder: one process at a time, and one that died holds nothing.

The file `lock` names the process and is locked (`flock`) while it lives: the kernel lets go when it ends, however it ends, so neither a
crash, nor a process id that was given to another, nor a container that starts again under another host name can leave a folder locked.
Where the file system does not lock, or its locks hold within one machine though others write to it too, the name decides: process id and
time of its start, counted from the machine's own start and so untouched by clocks set back.
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
from unrender.io import bounded_files
from unrender.runs.folder.schema import LOCK

_LARGEST = 1 << 12
_MOUNTS = Path("/proc/self/mountinfo")
_SERVER = re.compile(r"nfs4?$|cifs$|smb3$")
_SHARED = re.compile(
    r"nfs|cifs|smb|9p|afs|ceph|lustre|gpfs|beegfs|ocfs2|gfs2|orangefs|pvfs2|glusterfs|virtiofs|fuse(?!blk)|vboxsf|prl_fs"
)
"""File systems that several machines may write to."""
_WITHIN_ONE_MACHINE = {"nolock", "local_lock=flock", "local_lock=all", "nobrl"}
"""Options of those in whose presence locks are not passed on."""


@dataclass(frozen=True)
class Holder:
    """A process.

    Attributes:
        pid: its number.
        host: the machine.
        started: what tells it from another process of the same number: the machine's start and the process's since then.
    """

    pid: int
    host: str
    started: str

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}"

    def is_gone(self) -> bool:
        """Whether the process is known to have ended. One of another machine never is."""
        return self.host == platform.node() and _started(self.pid) != self.started


class Lock:
    """Holds a run folder from `acquire` on until `release`. The folder must be there."""

    def __init__(self, folder: Path):
        self.path = folder / LOCK
        self._file: int | None = None

    def acquire(self) -> None:
        """Raises `InputError` where another process holds the folder, or none can: one line that says who, or why."""
        try:
            while self._file is None:
                self._file = self._try()
        except OSError as error:
            raise InputError(f"run folder {self.path.parent}: cannot be locked: {error.strerror or error}") from error

    def is_held(self) -> bool:
        """Whether the folder still holds this lock: it may have been deleted, or deleted and locked by another process."""
        if self._file is None:
            return False
        with contextlib.suppress(OSError):
            return os.path.samestat(os.stat(self.path), os.fstat(self._file))
        return False

    def release(self) -> None:
        """Let the folder go. Harmless where it is not held."""
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
        """The locked file; None where it was deleted in between: then try again."""
        file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        locked = False
        try:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                locked = True
            except BlockingIOError:
                raise InputError(self._in_use(_read(self.path))) from None
            except OSError:
                pass  # a file system without locks: the name decides
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
    """The process that holds a run folder, as far as can be told without asking for it; None where none does, or it has ended."""
    found = _read(folder / LOCK)
    return None if found is None or found.is_gone() or _is_free(folder / LOCK) else found


def _is_free(path: Path) -> bool:
    """Whether the lock is known to be held by no process on any machine."""
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
    """Whether a lock of this file excludes every process that could hold it, on whatever machine.

    On a file system of this machine all processes ask its one kernel. NFS and SMB pass locks on to the server unless they are mounted not
    to; of others that several machines may share nothing is known.
    """
    device = os.fstat(file).st_dev
    number = f"{os.major(device)}:{os.minor(device)}"
    try:
        mounts = [line.split(" - ") for line in _MOUNTS.read_text().splitlines()]
    except OSError:
        return False  # not Linux: what it is cannot be told
    for mount, described in (parts for parts in mounts if len(parts) == 2):
        if mount.split()[2] == number:
            kind, _, options = described.split(" ", 2)
            return not _SHARED.match(kind) or (
                bool(_SERVER.match(kind)) and _WITHIN_ONE_MACHINE.isdisjoint(options.split(","))
            )
    return True  # btrfs and overlays have numbers that no mount has; what is shared has its own


def _read(path: Path) -> Holder | None:
    try:
        given = bounded_files.parse_json(bounded_files.read_bytes(path, _LARGEST), str(path))
        match given:
            case {"pid": int(pid), "host": str(host), "started": str(started)} if 0 < pid < 1 << 31:
                return Holder(pid, host[:200], started)
    except InputError:
        pass  # nothing there, or written by no run: nobody is named
    return None


def _started(pid: int) -> str:
    """When a process of this machine started; "" where there is none of that number."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        # The name, in parentheses, may hold anything; the 22nd field is the start in ticks since the machine's.
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
