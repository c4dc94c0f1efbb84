"""Start of Ray on this machine, or connection to a cluster after a check of access: its token, and its session's folder."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import queue
import signal
import socket
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent import futures
from dataclasses import dataclass, field
from typing import Any

from unrender.app.distributed.cluster.private import (
    check_cluster,
    check_private,
    check_token,
    has_token,
    private_cluster,
)
from unrender.app.distributed.cluster.workers import Share, Workers, most_by_memory, share
from unrender.backend import limits, variant
from unrender.core.errors import InputError, UnrenderError
from unrender.core.text import one_line, reason_of

_LOOK, _ANSWER, _PATIENCE = 3.0, 2.0, 15.0
"""Seconds between checks, time limit of an answer, and time without an answer after which the head node counts as lost. Ray itself
ends the process after 60 seconds, without an exception."""


def reach(address: str, seconds: float) -> None:
    """Open a connection to HOST:PORT within a time limit in seconds, and close it. Raises `OSError`."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), seconds).close()
    except OverflowError as error:
        raise OSError(str(error)) from error


class HeadNode:
    """Monitor of the head node at HOST:PORT; one at "" is never lost. Workers continue for some time without it, but nothing can be started
    or found."""

    def __init__(
        self,
        address: str = "",
        clock: Callable[[], float] = time.monotonic,
        reach: Callable[[str, float], None] = reach,
    ):
        self._address, self._clock, self._reach = address, clock, reach
        self._looked = self._answered = clock()

    def check(self) -> None:
        """Check the head node, at most every few seconds. Raise `InputError` if it has not answered for some time."""
        now = self._clock()
        if not self._address or now - self._looked < _LOOK:
            return
        self._looked = now
        try:
            self._reach(self._address, _ANSWER)
            self._answered = self._clock()
        except OSError as error:
            if now - self._answered > _PATIENCE:
                reason = error.strerror or str(error)
                raise InputError(
                    f"workers: the cluster's head node at {self._address} is lost ({reason}); start one, and continue with unrender resume "
                    "or unrender sweep DIR"
                ) from error


_SLICE = 0.25
"""Longest wait of one call in seconds, and thereby longest delay of an exception that a handler of signals raises."""
_ENDS = 10.0  # seconds that a call may take to end after such an exception


class Waiter:
    """Carries out the calls of Ray that block, in a thread of its own.

    In the main thread, Ray's compiled code runs the handlers of signals itself while it waits. Where a handler raises `SystemExit`, the
    process then ends with status 1, and other exceptions than `KeyboardInterrupt` become a `SystemError`. In other threads it runs no
    handlers.
    """

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[tuple[futures.Future[Any], Callable[[], Any]]] = queue.SimpleQueue()
        self._started = False

    def call(self, function: Callable[[], Any]) -> Any:
        """Return the value of a function that soon ends. An exception of a handler is raised after it has ended."""
        if threading.current_thread() is not threading.main_thread():
            return function()
        if not self._started:
            threading.Thread(target=self._serve, daemon=True).start()
            self._started = True
        call: futures.Future[Any] = futures.Future()
        self._calls.put((call, function))
        try:
            # The system may deliver a signal to another thread, which does not wake this one. So the wait ends now and then.
            while not futures.wait([call], _SLICE).done:
                pass
        except BaseException:
            futures.wait([call], _ENDS)  # nothing may leave Ray while a thread is in it
            raise
        return call.result()

    def wait(self, ray: Any, references: list[Any], count: int, seconds: float) -> list[Any]:
        """Return the references that are ready, once `count` of them are or after the given time."""
        while True:
            part = min(seconds, _SLICE)
            ready = self.call(lambda part=part: ray.wait(references, num_returns=count, timeout=part))[0]
            seconds -= part
            if len(ready) >= count or seconds <= 0:
                return ready

    def _serve(self) -> None:
        while True:
            _settle(*self._calls.get())  # without names, which would keep the last result


def _settle(call: futures.Future[Any], function: Callable[[], Any]) -> None:
    try:
        call.set_result(function())
    except BaseException as error:
        call.set_exception(error)


_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_USAGE_STATS_PROMPT_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_enable_metrics_collection": "0",
    "RAY_DISABLE_IMPORT_WARNING": "1",
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
    "RAY_IGNORE_UNHANDLED_ERRORS": "1",
    "RAY_DISABLE_FAILURE_SIGNAL_HANDLER": "1",
}
"""No telemetry, no metrics, only errors on standard error, and no handler of SIGTERM that prints a stack trace. Settings in the environment
take precedence."""
_STORE_BYTES = 256 << 20
_ANSWER_SECONDS = 10.0
_NAMESPACE = "unrender"


@dataclass(frozen=True)
class Cluster:
    """A connected Ray cluster, with the variant and the share of its workers, and its address; None for a local one."""

    ray: Any
    variant: str
    share: Share
    address: str | None
    head: HeadNode = field(default_factory=HeadNode)
    _waiter: Waiter = field(default_factory=Waiter, repr=False, compare=False)

    @property
    def resources(self) -> dict[str, float]:
        """Return the resources of each worker for Ray: `task.options(**cluster.resources)`. Ray sets CUDA_VISIBLE_DEVICES accordingly."""
        return {"num_cpus": self.share.cpus, "num_gpus": self.share.gpus}

    def wait(self, references: list[Any], count: int = 1, seconds: float = 0.0) -> set[Any]:
        """Return the references that are ready, once `count` of them are, or after some time. Handlers of signals may raise anything."""
        return set(self._waiter.wait(self.ray, references, count, seconds)) if references else set()

    def get(self, reference: Any, seconds: float | None = None) -> Any:
        """Return the object of a reference that is ready; raise Ray's `GetTimeoutError` if its transfer takes longer."""
        options = {} if seconds is None else {"timeout": seconds}
        return self._waiter.call(lambda: self.ray.get(reference, **options))


def load_ray() -> Any:
    """Return the module `ray`, configured to be silent. Raises `InputError` if it is not installed; the message states what to install."""
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    if has_token() and "ray" not in sys.modules:  # an imported ray has read the mode already
        os.environ.setdefault("RAY_AUTH_MODE", "token")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings of its dependencies
            import ray
    except ImportError as error:
        raise InputError(f"workers need Ray ({error}): pip install 'unrender[ray]'") from error
    loaded: Any = ray
    with contextlib.suppress(Exception):  # no setting silences messages about dead workers, which are reported here
        loaded._private.worker.print_to_stdstream = lambda *_, **__: None
    return loaded


@contextlib.contextmanager
def connect(
    workers: Workers, name: str = "auto", store_bytes: int = _STORE_BYTES, most: int | None = None
) -> Iterator[Cluster]:
    """Start Ray on this machine, or join a cluster; disconnect at the end, and stop a local cluster.

    Only this user can enter a local cluster. An existing cluster is joined if it appears to be closed to others. Handlers of SIGTERM
    and SIGINT do not change. A process has at most one connection.

    Args:
        workers: number of workers, and address. Without an address, the environment variable RAY_ADDRESS is used, if set.
        name: Mitsuba variant; "auto" for CUDA if there are GPUs, else LLVM, with the colours of this process's variant.
        store_bytes: shared memory for objects of a local cluster.
        most: maximum useful number of workers, see `share`.

    Raises:
        InputError: Ray is not installed, there is no cluster at the address, it is open to other users, it has no GPU though `name`
            requires one, or the process is already connected.
    """
    ray = load_ray()
    if ray.is_initialized():
        raise InputError("workers: this process is already connected to Ray")
    address = workers.address or os.environ.get("RAY_ADDRESS") or None
    with contextlib.ExitStack() as stack:
        if address is None:
            gpu = variant.is_on_gpu(name) or (name == "auto" and variant.gpu_problem() is None)
            init_options = stack.enter_context(private_cluster(ray))
            init_options |= {"num_cpus": limits.cores(), "include_dashboard": False, "object_store_memory": store_bytes}
            init_options |= {} if gpu else {"num_gpus": 0}
            most = most_by_memory(most)
        else:
            gpu = variant.is_on_gpu(name)
            init_options = {"address": address}
            _check_answers(address)
            if not workers.insecure:
                check_token(address)
                if _is_located(address):
                    check_cluster(ray, address)
        stack.callback(_leave, ray)
        _init(ray, address, init_options)
        gcs_address = ray.get_runtime_context().gcs_address
        if address is None:
            check_private(ray)
        elif not workers.insecure and not _is_located(address):
            check_cluster(ray, gcs_address)
        alive = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        machines = [(resources.get("CPU", 0.0), resources.get("GPU", 0.0)) for resources in alive]
        if name == "auto" and address is not None:
            gpu = any(gpus >= 1 for _, gpus in machines)
        if name == "auto":
            name = variant.with_colours_of(variant.CUDA if gpu else variant.LLVM, variant.current())
        yield Cluster(
            ray, name, share(machines, workers.count, gpu, most), workers.address or address, HeadNode(gcs_address)
        )


def _init(ray: Any, address: str | None, init_options: dict[str, Any]) -> None:
    where = "cannot start on this machine" if address is None else f"cannot be reached at {address}"
    quiet = {"logging_level": logging.ERROR, "log_to_driver": False, "configure_logging": True}
    with _own_signals():
        try:
            ray.init(namespace=_NAMESPACE, **quiet, **init_options)
        except Exception as error:  # of many kinds
            reason = one_line(reason_of(error, 200))
            raise InputError(f"workers: Ray {where}: {reason}") from error


def _is_located(address: str) -> bool:
    """Return whether an address is HOST:PORT. RAY_ADDRESS may hold "auto"."""
    _, colon, port = address.rpartition(":")
    return bool(colon) and port.isdigit()


def _check_answers(address: str) -> None:
    """Raise `InputError` if nothing listens at the address, which Ray would report only after two minutes."""
    if not _is_located(address):
        return
    try:
        reach(address, _ANSWER_SECONDS)
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"workers: no Ray cluster answers at {address}: {reason}") from error


def _leave(ray: Any) -> None:
    with _own_signals(), contextlib.suppress(UnrenderError, Exception):
        ray.shutdown()


@contextlib.contextmanager
def _own_signals() -> Iterator[None]:
    """Keep the signal handlers: Ray installs its own for SIGTERM, and its shutdown sets the system's default action."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    received = 0
    try:
        with _restored_action(signal.SIGTERM):
            yield
    except SystemExit as end:  # raised by Ray's handler
        received = end.code if end.code == signal.SIGTERM else 0
        if not received:
            raise
    finally:
        for number, handler in before.items():
            if handler is not None:
                signal.signal(number, handler)
    if received:
        signal.raise_signal(signal.SIGTERM)
        raise KeyboardInterrupt


_EVERY = 0.01  # seconds between restorations of a signal's action
_LARGEST_ACTION = 1024  # bytes, more than `struct sigaction` has on any system


@contextlib.contextmanager
def _restored_action(number: int) -> Iterator[None]:
    """Keep the system's action of a signal. Ray's compiled code sets one that prints a stack trace, and Python does not notice.

    It does so if its version does not know `RAY_DISABLE_FAILURE_SIGNAL_HANDLER`, or if a program has imported it without that setting.
    """
    library, action = ctypes.CDLL(None), ctypes.create_string_buffer(_LARGEST_ACTION)
    library.sigaction(number, None, action)
    ended = threading.Event()

    def restore() -> None:
        while not ended.wait(_EVERY):
            library.sigaction(number, action, None)

    thread = threading.Thread(target=restore, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
