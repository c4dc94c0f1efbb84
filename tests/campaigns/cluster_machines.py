"""Two machines of a Ray cluster in one: network namespaces, and a link between them of a given rate and delay. Only root can have them."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType

from benchmarks.runner.catalogue import ROOT
from tests.campaigns.delay_line import DelayLine

__all__ = ["Link", "Machines", "processes_below"]

_NETWORK = "10.77.77"
_PORT = 6391
_MTU = 9000
_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_enable_metrics_collection": "0",
    "RAY_DISABLE_IMPORT_WARNING": "1",
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
    "RAY_worker_niceness": "0",  # its own would starve workers on a busy machine
}


def processes_below(root: int) -> dict[int, str]:
    """{process id: command line} of a process and all that it started, directly or not."""
    parents, words = {}, {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError, ValueError, IndexError):
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                words[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    found, new = {root}, {root}
    while new:
        new = {child for child, parent in parents.items() if parent in new} - found
        found |= new
    return {pid: words.get(pid, "") for pid in sorted(found) if pid in words}


class Link:
    """Two network namespaces, "unrender-0" and "unrender-1", joined by a pair of interfaces. A context manager.

    Without a delay the rate is kept by the kernel (`tc`, token bucket filter); with one, by a `DelayLine`, since kernels may lack `netem`.

    Args:
        megabits: that it lets through a second, each way; None for as many as come.
        milliseconds: there and back.
    """

    def __init__(self, megabits: float | None = None, milliseconds: float = 0.0):
        self._megabits, self._milliseconds = megabits, milliseconds
        self._line: DelayLine | None = None

    def __enter__(self) -> Link:
        self._remove()
        for n in range(2):
            _call("ip", "netns", "add", self.name(n))
        if self._megabits is None or not self._milliseconds:
            ends = [("netns", self.name(n)) for n in range(2)]
            _call("ip", "link", "add", self.name(0), *ends[0], "type", "veth", "peer", self.name(1), *ends[1])
        else:
            self._line = DelayLine((self.name(0), self.name(1)), self._megabits, self._milliseconds / 2)
            for n in range(2):
                _call("ip", "link", "set", self.name(n), "mtu", _MTU, "netns", self.name(n))
        for n in range(2):
            self.call(n, "ip", "address", "add", f"{_NETWORK}.{n + 1}/24", "dev", self.name(n))
            for device in (self.name(n), "lo"):
                self.call(n, "ip", "link", "set", device, "up")
            if self._megabits is not None and self._line is None:
                limit = ("rate", f"{self._megabits}mbit", "burst", "256kb", "latency", "400ms")
                self.call(n, "tc", "qdisc", "add", "dev", self.name(n), "root", "tbf", *limit)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._line is not None:
            self._line.close()
        self._remove()

    @staticmethod
    def name(n: int) -> str:
        """Of a namespace, and of its interface."""
        return f"unrender-{n}"

    def carried(self) -> int:
        """Bytes that went over the link so far, both ways."""
        folder = f"/sys/class/net/{self.name(0)}/statistics"
        text = self.call(0, "cat", f"{folder}/rx_bytes", f"{folder}/tx_bytes")
        return sum(map(int, text.split()))

    def words(self, n: int, *words: object) -> list[str]:
        """A command, to be carried out in a namespace."""
        return ["ip", "netns", "exec", self.name(n), *map(str, words)]

    def call(self, n: int, *words: object) -> str:
        """Carry it out; what it prints."""
        return _call(*self.words(n, *words))

    def _remove(self) -> None:
        for n in range(2):
            subprocess.run(["ip", "netns", "del", self.name(n)], check=False, capture_output=True)


class Machines:
    """A node of Ray in each namespace, each with one core to give. A context manager.

    Args:
        link: between them.

    Attributes:
        head: which is the head node.
    """

    def __init__(self, link: Link):
        self.link, self.head, self._token = link, 0, secrets.token_hex(32)
        self._nodes: dict[int, subprocess.Popen[bytes]] = {}
        self._folder = Path(tempfile.mkdtemp(prefix="unrender-rb-", dir="/tmp"))

    def __enter__(self) -> Machines:
        try:
            for n in range(2):
                self.start(n)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for n in list(self._nodes)[::-1]:
            self.kill(n)
        shutil.rmtree(self._folder, ignore_errors=True)

    @property
    def address(self) -> str:
        """Of the head node."""
        return f"{_NETWORK}.{self.head + 1}:{_PORT}"

    def move_head(self) -> None:
        """Kill both nodes, and start both with the other as head: another address, and nothing of the earlier cluster is left."""
        for n in list(self._nodes):
            self.kill(n)
        self.head = 1 - self.head
        for n in (self.head, 1 - self.head):
            self.start(n)

    def start(self, n: int) -> None:
        """Start a node, and wait until it is there; the head has to be the first."""
        ray = (sys.executable, "-m", "ray.scripts.scripts", "start")
        own = ["--head", f"--port={_PORT}", "--include-dashboard=false", f"--temp-dir={self._folder / 'r'}"]
        words = [
            *(own if n == self.head else [f"--address={self.address}"]),
            f"--node-ip-address={_NETWORK}.{n + 1}",
            "--num-cpus=1",
            "--num-gpus=0",
            "--object-store-memory=100000000",
            "--disable-usage-stats",
            "--block",
        ]
        with (self._folder / f"node{n}.log").open("ab") as log:
            self._nodes[n] = subprocess.Popen(
                self.link.words(n, *ray, *words),
                stdout=log,
                stderr=log,
                env=self.environment,
                start_new_session=True,
            )
        self._await(n, log.name)

    @property
    def environment(self) -> dict[str, str]:
        """Of nodes and of commands."""
        path = os.pathsep.join([str(ROOT), str(ROOT / "src")])
        token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": self._token}
        return {**os.environ, **_QUIET, **token, "PYTHONPATH": path, "COLUMNS": "200"}

    def kill(self, n: int) -> None:
        """Kill a node and all that it runs (SIGKILL)."""
        node = self._nodes.pop(n)
        for pid in processes_below(node.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        node.wait()

    def is_up(self, n: int) -> bool:
        """Whether a node runs."""
        return n in self._nodes

    def workers(self) -> list[int]:
        """The processes that hold views."""
        nodes = [pid for node in self._nodes.values() for pid in processes_below(node.pid).items()]
        return [pid for pid, words in nodes if words.startswith("ray::ViewWorker")]

    def begin(self, *words: object, log: Path) -> subprocess.Popen[bytes]:
        """A command of Python on the head node."""
        command = self.link.words(self.head, sys.executable, *words)
        with log.open("ab") as file:
            return subprocess.Popen(
                command, stdout=file, stderr=file, env=self.environment, cwd=ROOT, start_new_session=True
            )

    def _await(self, n: int, log: str, seconds: float = 240.0) -> None:
        end, said = time.monotonic() + seconds, ""
        code = (
            "import ray, sys\n"
            f"ray.init(address={self.address!r}, logging_level='ERROR', log_to_driver=False)\n"
            f"sys.exit(not any(x['Alive'] and x['NodeManagerAddress'] == '{_NETWORK}.{n + 1}' for x in ray.nodes()))"
        )
        while time.monotonic() < end and self._nodes[n].poll() is None:
            done = subprocess.run(
                self.link.words(self.head, sys.executable, "-c", code),
                env=self.environment,
                capture_output=True,
                check=False,
            )
            if done.returncode == 0:
                return
            said = done.stderr.decode(errors="replace")[-300:]
            time.sleep(1.0)
        raise RuntimeError(f"node {n} of Ray did not start: {said or Path(log).read_text()[-300:]}")


def _call(*words: object) -> str:
    return subprocess.run([str(word) for word in words], check=True, capture_output=True, text=True).stdout
