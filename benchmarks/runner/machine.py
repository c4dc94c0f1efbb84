"""How busy the machine is with other work: figures of time are worth what the machine was free."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

LOADED = 0.15
"""Share of the processors that others take, from which on a warning is printed."""


def busy_seconds() -> float | None:
    """Processor seconds of all processes since the machine began; None where it does not tell (other systems than Linux)."""
    try:
        fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
    except OSError:
        return None
    user, nice, system, _, _, irq, softirq, *_ = map(int, fields)
    return (user + nice + system + irq + softirq) / os.sysconf("SC_CLK_TCK")


class Load:
    """The share of the processors that other processes take: a moment before, and during the run."""

    def __init__(self, moment: float = 0.5):
        self._mark()
        time.sleep(moment)
        self.before = self._others()
        _say("before the run", self.before)
        self._mark()

    def after(self) -> dict[str, Any]:
        """For the record: "before" and "during" (None where unknown), and the load average (one minute) at the end."""
        during = self._others()
        _say("during the run", during)
        average = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
        return {"before": self.before, "during": during, "average_after": average}

    def _mark(self) -> None:
        self._began, self._busy, self._own = time.perf_counter(), busy_seconds(), sum(os.times()[:4])

    def _others(self) -> float | None:
        busy = busy_seconds()
        if busy is None or self._busy is None:
            return None
        available = (os.cpu_count() or 1) * (time.perf_counter() - self._began)
        return round(max(busy - self._busy - (sum(os.times()[:4]) - self._own), 0.0) / available, 3)


def _say(when: str, share: float | None) -> None:
    if share is not None:
        print(f"load {when}: other processes take {share:.0%} of the processors", flush=True)
        if share > LOADED:
            print("warning: the machine is loaded; absolute times, and races at equal time, will be off", flush=True)
