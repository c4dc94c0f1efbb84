"""How workers are counted and share machines, and what becomes of tasks; Ray is needed by none of this."""

from __future__ import annotations

import os
import pickletools
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from unrender.app.distributed.cluster import (
    Cluster,
    Ended,
    InProcess,
    OnWorkers,
    Share,
    Workers,
    connect,
    load_ray,
    share,
    workers,
)
from unrender.app.distributed.cluster.connection import HeadNode, Waiter
from unrender.backend import limits
from unrender.core.errors import InputError


def test_what_workers_may_say() -> None:
    assert Workers.parse("auto") == Workers()
    assert Workers.parse(" 4") == Workers(4)
    assert Workers.parse("10.0.0.1:6379") == Workers(None, "10.0.0.1:6379")
    assert Workers.parse("8@head-node:6379") == Workers(8, "head-node:6379")
    assert Workers.parse("auto@[::1]:6379") == Workers(None, "[::1]:6379")


@pytest.mark.parametrize(
    "text", ["", "0", "-1", "1.5", "²", "many", "4@", "@", "host", "host:", "host:0", "host:99999", "a b:1", "9" * 30]
)
def test_what_workers_may_not_say(text: str) -> None:
    with pytest.raises(InputError, match="expected auto, a number, the address HOST:PORT"):
        Workers.parse(text)


def test_addresses_for_clients_outside_of_a_cluster_are_refused_with_a_hint() -> None:
    with pytest.raises(InputError, match="start the command on a machine of the cluster"):
        Workers.parse("ray://10.0.0.1:10001")


def test_processors_are_shared() -> None:
    assert share([(8, 0)], None, gpu=False) == Share(8, 1.0, 0.0)
    assert share([(16, 0)], None, gpu=False, most=4) == Share(4, 4.0, 0.0)  # all cores for four workers
    assert share([(2, 0)], None, gpu=False, most=4) == Share(2, 1.0, 0.0)
    assert share([(8, 2)], 3, gpu=False) == Share(3, 2.0, 0.0)
    assert share([(2, 0)], 5, gpu=False) == Share(5, 1 / 3, 0.0)
    assert share([(6, 0), (3, 0)], 4, gpu=False).cpus == 2.0  # 3 and 1; with 3 cores each, only 3 fit
    assert share([(6, 0), (3, 0)], 4, gpu=False).threads == 2
    assert share([(2, 0)], 5, gpu=False).threads == 1


def test_gpus_are_shared() -> None:
    assert share([(32, 4)], None, gpu=True) == Share(4, 8.0, 1.0)
    assert share([(32, 4)], 2, gpu=True) == Share(2, 8.0, 1.0)  # never two GPUs for one
    assert share([(16, 2)], 8, gpu=True) == Share(8, 2.0, 0.25)
    assert share([(2, 1)], 4, gpu=True) == Share(4, 1 / 2, 0.25)
    assert share([(64, 0), (16, 2), (8, 2)], None, gpu=True) == Share(4, 4.0, 1.0)
    with pytest.raises(InputError, match="no machine with a GPU"):
        share([(8, 0)], None, gpu=True)


@pytest.mark.parametrize("count", range(1, 40))
def test_all_workers_find_room(count: int) -> None:
    for machines in ([(2, 0)], [(5, 0), (3, 0), (1, 0)], [(7, 2), (16, 3)], [(2, 4)]):
        for gpu in (False, True):
            if not any(g for _, g in machines) and gpu:
                continue
            found = share(machines, count, gpu)
            fits = 0
            for cores, gpus in machines:
                by_cores = int(cores / found.cpus + 1e-9)
                fits += min(by_cores, int(gpus / found.gpus + 1e-9)) if gpu else by_cores
            assert fits >= count, (machines, gpu, found)


@pytest.mark.parametrize(
    ("free", "most", "expected"), [(0, 7, 7), (0, None, None), (1 << 31, None, 4), (1 << 31, 3, 3), (1, 3, 1)]
)
def test_workers_of_one_machine_fit_its_memory(
    monkeypatch: pytest.MonkeyPatch, free: int, most: int | None, expected: int | None
) -> None:
    monkeypatch.setattr(limits, "free_memory", lambda: free)
    assert workers.most_by_memory(most) == expected
    if expected:
        assert share([(64.0, 0.0)], None, False, expected).count == expected


def test_without_ray_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install 'unrender\[ray\]'"):
        load_ray()
    with pytest.raises(InputError, match=r"pip install 'unrender\[ray\]'"), connect(Workers(2)):
        pass


def test_an_address_where_nobody_listens_is_one_line_at_once() -> None:
    pytest.importorskip("ray")
    with (
        pytest.raises(InputError, match="no Ray cluster answers"),
        connect(Workers(None, "127.0.0.1:9")),
    ):
        pass


def test_the_package_imports_neither_ray_nor_optuna() -> None:
    code = (
        "import sys, pkgutil, importlib, unrender\n"
        "for name in sorted(unrender.__all__): getattr(unrender, name)\n"
        "import unrender.app.cli.app, unrender.app.distributed.cluster\n"
        "print({'ray', 'optuna'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_a_head_node_that_is_lost_is_one_line_and_one_that_comes_back_is_none() -> None:
    now, up = [0.0], [True]

    def reach(address: str, seconds: float) -> None:
        assert (address, seconds) == ("head:1", 2.0)
        if not up[0]:
            raise OSError(111, "Connection refused")

    def watch(answers: bool, until: float) -> None:
        up[0] = answers
        while now[0] < until:
            now[0] += 1
            head.check()

    head = HeadNode("head:1", lambda: now[0], reach)
    for answers, until in ((True, 30), (False, 44), (True, 60)):
        watch(answers, until)
    with pytest.raises(InputError, match=r"head node at head:1 is lost \(Connection refused\); start one"):
        watch(False, 90)
    assert 75 < now[0] < 80


# ---------------------------------------------------------------------- tasks


class Died(Exception):
    """As of Ray: a worker is gone."""


class Raised(Died):
    """As of Ray: the function raised."""

    cause = InputError("no such file")


class Alone(Died):
    """As of Ray: its node on this machine is gone."""


class FakeRay:
    """Answers in the place of Ray; `deaths` of the first attempts at a task end with the worker's death."""

    exceptions = SimpleNamespace(RayError=Died, RayTaskError=Raised, LocalRayletDiedError=Alone)

    def __init__(self, deaths: dict[str, int]):
        self.deaths, self.begun, self.cancelled = deaths, [], []

    def remote(self, function: Callable[..., Any]) -> Any:
        def begin(*arguments: Any) -> Any:
            self.begun.append(arguments[0])
            return (len(self.begun), arguments)

        return SimpleNamespace(options=lambda **_: SimpleNamespace(remote=begin))

    def wait(self, references: list, num_returns: int, timeout: float) -> tuple[list, list]:
        del timeout
        return references[:num_returns], []

    def get(self, reference: Any) -> str:
        name = reference[1][0]
        if name == "bad":
            raise Raised
        if name == "alone":
            raise Alone
        if self.cancelled and name != "fine":
            raise Died("cancelled")
        if self.begun.count(name) <= self.deaths.get(name, 0):
            raise Died("The worker died unexpectedly. Look at its logs.")
        return f"{name} done"


def test_a_death_costs_its_task_alone_which_is_begun_again_twice() -> None:
    ray = FakeRay({"unlucky": 1, "doomed": 9})
    workers = OnWorkers(Cluster(ray, "llvm_ad_rgb", Share(4, 1.0, 0.0), None), str)
    for name in ("fine", "unlucky", "doomed", "bad"):
        workers.start(name, name)
    ended: dict[str, Ended] = {}
    for _ in range(10):
        ended |= {one.key: one for one in workers.wait(0.0)}
    assert workers.pending == 0
    assert ended["fine"] == Ended("fine", "fine done", "", 1)
    assert ended["unlucky"] == Ended("unlucky", "unlucky done", "", 2)
    assert ended["doomed"].message == "its worker died 3 times: The worker died unexpectedly"
    assert ended["bad"] == Ended("bad", None, "no such file", 1)
    assert [ray.begun.count(name) for name in ("fine", "unlucky", "doomed", "bad")] == [1, 2, 3, 1]


def test_a_lost_node_ends_the_command_and_fails_no_task() -> None:
    executor = OnWorkers(Cluster(FakeRay({}), "llvm_ad_rgb", Share(4, 1.0, 0.0), None), str)
    executor.start(1, "alone")
    with pytest.raises(InputError, match=r"Ray's node on this machine is lost; .*continue with unrender sweep DIR"):
        executor.wait(0.1)


def test_after_an_interrupt_only_tasks_that_ended_in_good_order_are_told() -> None:
    class Interrupted(FakeRay):
        def wait(self, references: list, num_returns: int, timeout: float) -> tuple[list, list]:
            if not self.cancelled and timeout:
                raise KeyboardInterrupt
            return super().wait(references, num_returns, timeout)

        def cancel(self, reference: Any) -> None:
            self.cancelled.append(reference)

    ray = Interrupted({})
    workers = OnWorkers(Cluster(ray, "llvm_ad_rgb", Share(4, 1.0, 0.0), None), str)
    for name in ("fine", "late"):
        workers.start(name, name)
    with pytest.raises(KeyboardInterrupt):
        workers.wait(0.5)
    assert len(ray.cancelled) == 2
    assert workers.saved() == [Ended("fine", "fine done")]
    assert (workers.pending, workers.saved()) == (0, [])
    assert ray.begun == ["fine", "late"]  # none is begun again


def test_an_exception_of_a_signals_handler_is_raised_once_the_call_has_ended() -> None:
    ended: list[bool] = []

    def handler(number: int, frame: object) -> None:
        raise SystemExit(7)

    def slow() -> None:
        os.kill(os.getpid(), signal.SIGUSR1)
        time.sleep(0.3)
        ended.append(True)

    before = signal.signal(signal.SIGUSR1, handler)
    try:
        waiter = Waiter()
        with pytest.raises(SystemExit, match="7"):
            waiter.call(slow)
        assert ended
        assert waiter.call(lambda: 3) == 3
        with pytest.raises(ZeroDivisionError):
            waiter.call(lambda: 1 / 0)
    finally:
        signal.signal(signal.SIGUSR1, before)


def test_in_this_process_a_failure_is_a_line_and_an_interrupt_passes() -> None:
    def function(error: BaseException | None) -> str:
        if error is not None:
            raise error
        return "done"

    here = InProcess(function)
    for key, error in enumerate((None, InputError("wrong"), ValueError("a\nb"), KeyboardInterrupt())):
        here.start(key, error)
    assert [here.wait(0.0)[0] for _ in range(3)] == [
        Ended(0, "done"),
        Ended(1, None, "wrong"),
        Ended(2, None, "ValueError: a b"),
    ]
    with pytest.raises(KeyboardInterrupt):
        here.wait(0.0)
    assert here.wait(0.0) == []


def test_tasks_are_data_and_functions_go_by_name() -> None:
    """Ray pickles what it sends. Nothing in a task of `sweep` or `compare` is code."""
    from unrender.app.cli import tasks

    cloudpickle = pytest.importorskip("ray").cloudpickle
    job = tasks.Job("room.toml", {"resolution": "16"}, True, "unrender sweep", "/sweep", "token")
    run = tasks.RunTask("trial-000", "plain", {"spp": "2"}, 3, None, 0, 1)
    sent = cloudpickle.dumps((tasks.on_worker, job, [run]))
    words = [argument for _, argument, _ in pickletools.genops(sent) if isinstance(argument, str)]
    modules = {word for word in words if word.startswith(("unrender.", "ray", "builtins", "types", "cloudpickle"))}
    assert modules == {"unrender.app.cli.tasks"}
    assert {"on_worker", "Job", "RunTask"} <= set(words)
    by_value = cloudpickle.dumps(lambda: run)
    assert b"cloudpickle" in by_value, "a function that goes by value is told apart"


@pytest.mark.parametrize("when", ["meanwhile", "afterwards"])
def test_signals_are_handled_while_and_after_ray_changes_their_action(when: str) -> None:
    """Its compiled code does, which Python does not notice: the command would end without a line, or with a stack trace."""
    code = textwrap.dedent("""
        import ctypes, os, signal, sys, time, types
        from unrender.app.distributed.cluster import connection
        signal.signal(signal.SIGTERM, lambda *_: print("handled", flush=True))
        end = lambda: os.kill(os.getpid(), signal.SIGTERM)
        def shutdown():
            ctypes.CDLL(None).signal(signal.SIGTERM, None)
            if sys.argv[1] == "meanwhile":
                time.sleep(0.5)
                end()
        connection._leave(types.SimpleNamespace(shutdown=shutdown))
        if sys.argv[1] == "afterwards":
            end()
    """)
    done = subprocess.run([sys.executable, "-c", code, when], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "handled\n", "")
