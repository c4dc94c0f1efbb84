"""Commands under memory limits, by `ulimit -v` or a container: failures are one line, whatever native code does.

A library without memory may raise anything, abort, or hang. A command with too little address space therefore does not start. Under a
limit, the command runs in a child process, and the parent reports its death by a signal as one line.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import sys
from collections.abc import Iterator
from types import FrameType

from unrender.app.cli.signals import ENVIRONMENT
from unrender.backend import limits
from unrender.core.errors import VariantError
from unrender.core.text import one_line

_BASE, _PER_CORE = 800 << 20, 64 << 20
"""Address space in bytes of the smallest problem with a renderer: of libraries, and of a thread's stack and heap per core."""
_MARGIN = 64 << 20
_SIGNS = re.compile(
    r"bad_alloc|out of memory|cannot allocate memory|unable to allocate|failed to map segment|resource temporarily unavailable"
    r"|can't start new thread",
    re.IGNORECASE,
)
_PASSED_ON = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2")
_GIVING_UP = b"OpenBLAS error: Memory allocation still failed"
_OF_MEMORY = ("SIGABRT", "SIGSEGV", "SIGBUS", "SIGKILL", "SIGILL", "SIGTRAP")
_DEATH_OF_PARENT = 1  # PR_SET_PDEATHSIG

_is_child = False


def check() -> None:
    """Raise `VariantError` if `ulimit -v` leaves too little address space to load the libraries."""
    if not (limit := limits.address_space()):
        return
    needed = _BASE + _PER_CORE * limits.cores()
    if limit < needed:
        raise VariantError(
            f"memory: {_described()}, expected at least {needed >> 10} kB on {limits.cores()} cores; raise it: ulimit -v unlimited"
        )


def is_limited() -> bool:
    """Return whether the command needs a parent: memory is limited, and this system can end a child with its parent."""
    return sys.platform == "linux" and bool(limits.address_space() or limits.group_memory())


def exhausted(error: BaseException) -> bool:
    """Return whether an error is due to a lack of memory: its text says so, or less than 64 MiB of the address space were unused."""
    limit = limits.address_space()
    return says_so(error) or 0 < limit < limits.most_address_space() + _MARGIN


def says_so(error: BaseException) -> bool:
    """Return whether an error, or one of its causes, reports a lack of memory."""
    return any(isinstance(each, MemoryError) or _SIGNS.search(str(each)) for each in _chain(error))


def exhaustion(how: str = "") -> str:
    """Return the line for a command that ran out of memory; `how` is inserted after the limits."""
    try:
        limit = f" ({described})" if (described := _described()) else ""
    except MemoryError:  # not enough memory to read the limits
        limit = ""
    return (
        f"out of memory{limit}{how}; files of a run remain. Allow more memory, or use fewer samples (--set spp=N), "
        "smaller pictures or fewer --threads"
    )


def supervised() -> int | None:
    """Run the rest of the command in a child process. Return None in the child, and the exit status in the parent once the child has ended.

    The child's standard error is shown when it ends, and is dropped if native code aborted it. The child has its own process group, so
    that a signal reaches it only once, through its parent. Signals are blocked until both can handle them.
    """
    global _is_child
    errors = os.memfd_create("unrender-errors")
    sys.stdout.flush()
    sys.stderr.flush()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [*map(signal.Signals.__getitem__, _PASSED_ON), signal.SIGTSTP])
    parent, child = os.getpid(), os.fork()
    if child == 0:
        _is_child = True
        os.setpgid(0, 0)
        os.dup2(errors, 2)
        os.close(errors)
        import ctypes  # slow to import, and only needed under a limit

        ctypes.CDLL(None).prctl(_DEATH_OF_PARENT, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(ENVIRONMENT)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        return None
    with contextlib.suppress(OSError):
        os.setpgid(child, child)
    with _passing_on(child):
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    name = "" if status >= 0 else signal.Signals(-status).name
    if name in _OF_MEMORY:
        print(f"unrender: {one_line(exhaustion(f', it seems: {name} ended the process'))}", file=sys.stderr)
        return ENVIRONMENT
    with os.fdopen(errors, "rb") as file:
        file.seek(0)
        if status == 1 and _GIVING_UP in file.read():  # OpenBLAS ends the process itself
            print(f"unrender: {one_line(exhaustion())}", file=sys.stderr)
            return ENVIRONMENT
        file.seek(0)
        shutil.copyfileobj(file, sys.stderr.buffer)
        sys.stderr.flush()
    if name:
        signal.signal(-status, signal.SIG_DFL)
        os.kill(parent, -status)
    return status


def drop_errors() -> None:
    """Discard the libraries' output on standard error before the line with the reason, in a supervised child."""
    if _is_child:
        sys.stderr.flush()
        os.ftruncate(2, 0)
        os.lseek(2, 0, os.SEEK_SET)


@contextlib.contextmanager
def _passing_on(child: int) -> Iterator[None]:
    """Forward signals to the child, and stop and continue together with it."""

    def pass_on(number: int, frame: FrameType | None) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, number)

    def stop(number: int, frame: FrameType | None) -> None:
        pass_on(signal.SIGSTOP, frame)
        os.kill(os.getpid(), signal.SIGSTOP)
        pass_on(signal.SIGCONT, frame)

    handlers = dict.fromkeys(map(signal.Signals.__getitem__, _PASSED_ON), pass_on) | {signal.SIGTSTP: stop}
    for number, handler in handlers.items():
        if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
    try:
        yield
    finally:
        for number in handlers:
            signal.signal(number, signal.SIG_IGN)


def _described() -> str:
    parts = []
    if limit := limits.address_space():
        parts.append(f"ulimit -v allows {limit >> 10} kB of address space")
    if limit := limits.group_memory():
        parts.append(f"the container allows {limit >> 20} MB")
    return ", ".join(parts)


def _chain(error: BaseException) -> Iterator[BaseException]:
    seen: set[int] = set()
    following: BaseException | None = error
    while following is not None and id(following) not in seen:
        seen.add(id(following))
        yield following
        following = following.__cause__ or following.__context__
