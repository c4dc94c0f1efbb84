"""Threads take turns, or are refused in one line; calls within one may be nested."""

from __future__ import annotations

import threading
import time

import drjit as dr
import pytest
from drjit.llvm.ad import Array4f, Float, UInt32

from unrender.core.errors import InputError
from unrender.core.exclusive import exclusive


def test_short_calls_of_different_threads_wait_for_one_another() -> None:
    inside: list[int] = []

    @exclusive("render")
    def render(depth: int = 2) -> None:
        inside.append(1)
        assert len(inside) <= 3
        time.sleep(0.005)
        if depth:
            render(depth - 1)
        inside.pop()

    failed: list[BaseException] = []

    def work() -> None:
        try:
            render()
        except BaseException as error:  # threads do not pass on what they raise
            failed.append(error)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []


def test_what_would_wait_for_hours_is_refused() -> None:
    begun, end = threading.Event(), threading.Event()

    @exclusive("optimize", long=True)
    def optimize() -> str:
        begun.set()
        end.wait(10)
        return nested()

    @exclusive("render")
    def nested() -> str:
        return "done"

    found: list[str] = []
    thread = threading.Thread(target=lambda: found.append(optimize()))
    thread.start()
    begun.wait(10)
    for call, name in ((nested, "render"), (optimize, "optimize")):
        with pytest.raises(
            InputError, match=rf"^{name}: optimize is running in another thread, .* use another process$"
        ):
            call()
    end.set()
    thread.join()
    assert found == ["done"]
    assert nested() == "done"


def test_an_error_ends_the_turn() -> None:
    @exclusive("optimize", long=True)
    def fail() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    found: list[str] = []
    thread = threading.Thread(target=lambda: found.append(exclusive("render")(lambda: "done")()))
    thread.start()
    thread.join()
    assert found == ["done"]


def test_the_callers_suspended_gradients_stay_outside() -> None:
    """A run within `dr.suspend_grad()` had gradients of 0 and ended as finished, with its start as the result."""

    @exclusive("estimate")
    def slope() -> float:
        x = Float(3.0)
        dr.enable_grad(x)
        dr.backward(x * x)
        return dr.grad(x)[0]

    with dr.suspend_grad():
        assert slope() == 6.0
        assert not dr.grad_enabled(_enabled())
    assert slope() == 6.0


def test_debug_mode_does_not_drop_gradients() -> None:
    """Dr.Jit 1.5 drops valid writes of packets there: a quarter of the gradient of a 32 x 32 texture was missing."""

    @exclusive("estimate")
    def total() -> float:
        x = dr.zeros(Float, 4096)
        dr.enable_grad(x)
        dr.backward(dr.sum(dr.gather(Array4f, x, dr.arange(UInt32, 1024))))
        return dr.sum(dr.grad(x))[0]

    assert total() == 4096.0
    with dr.scoped_set_flag(dr.JitFlag.Debug, True):
        assert total() == 4096.0
        assert dr.flag(dr.JitFlag.PacketOps)


def _enabled() -> Float:
    x = Float(3.0)
    dr.enable_grad(x)
    return x * x
