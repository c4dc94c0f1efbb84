"""`python -m scripts.golden`: record short descents, or compare with the record."""

from __future__ import annotations

import argparse
import json
import platform
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from benchmarks.runner import records
from scripts.golden.cases import METHODS, OPTIMIZERS, PROBLEMS, Trajectory, descend, optimize

__all__ = ["compare", "main", "summary"]

RECORD = Path(__file__).parent / "record.json"
_SEEDS = 3
"""Of a record: the scatter is between them."""
_ROUNDING = 1e-5
"""Relative difference of parameters that counts as scatter where seeds make none."""


def main(arguments: Sequence[str]) -> int:
    """Record or check. The status is 1 where a trajectory differs by more than seeds do."""
    parser = argparse.ArgumentParser("python -m scripts.golden", description=__doc__)
    parser.add_argument("--record", action="store_true", help="write the record, of three seeds; else compare with it")
    parser.add_argument("--check", action="store_true", help="compare with the record (the default)")
    parser.add_argument("--file", type=Path, default=RECORD, help="the record (scripts/golden/record.json)")
    parser.add_argument("--only", default="", help="regular expression that the case's name must contain")
    given = parser.parse_args(arguments)
    import drjit as dr

    variant = ur.use()
    dr.set_thread_count(1)  # sums of several threads have no fixed order
    wanted = {name: run for name, run in _cases() if re.search(given.only, name)}
    if given.record:
        found = {}
        for name, run in wanted.items():
            found[name] = summary(run)
            print(f"{name}: {found[name].get('refused', 'recorded')}", flush=True)
            _write(given.file, found, variant)
        return 0
    known = json.loads(given.file.read_text())["cases"]
    counts: dict[str, int] = {}
    for name, run in wanted.items():
        verdict = compare(known[name], summary(run, seeds=1)) if name in known else "differs: not in the record"
        kind = verdict.partition(":")[0]
        counts[kind] = counts.get(kind, 0) + 1
        print(f"{name}: {verdict}", flush=True)
    print(", ".join(f"{count} {kind}" for kind, count in counts.items()))
    return int("differs" in counts)


def summary(run: Callable[[int], Trajectory], seeds: int = _SEEDS) -> dict[str, Any]:
    """What a record keeps of a case: losses and hashes of the first seed's steps, sketches of all seeds' ends."""
    try:
        found = [run(seed) for seed in range(seeds)]
    except ur.InputError as error:
        return {"refused": str(error)}
    except RuntimeError as error:  # of Dr.Jit or Mitsuba, whose texts hold addresses
        return {"refused": type(error).__name__}
    sketches = [{key: [float(f"{x:.7g}") for x in each] for key, each in one.sketch.items()} for one in found]
    return {"losses": found[0].losses, "hashes": found[0].hashes, "sketches": sketches}


def compare(known: Mapping[str, Any], found: Mapping[str, Any]) -> str:
    """Say how a trajectory stands to its record: "equal", "within seed scatter: ..." or "differs: ..."."""
    if "refused" in known or "refused" in found:
        if known.get("refused") == found.get("refused"):
            return "equal"
        return f"differs: {known.get('refused', 'it ran')} -> {found.get('refused', 'it runs')}"
    if (known["losses"], known["hashes"]) == (found["losses"], found["hashes"]):
        return "equal"
    pairs = zip(known["losses"], known["hashes"], found["losses"], found["hashes"], strict=False)
    step = next((n for n, (a, b, c, d) in enumerate(pairs) if (a, b) != (c, d)), len(known["losses"]))
    new, worst = found["sketches"][0], 0.0
    if new.keys() != known["sketches"][0].keys():
        return f"differs: parameters {', '.join(new)}"
    for key, sketch in new.items():
        recorded = [np.array(one[key]) for one in known["sketches"]]
        spread = max(_size(a - b) for a in recorded for b in recorded)
        allowed = spread + _ROUNDING * _size(recorded[0])
        distance = _size(np.array(sketch) - recorded[0])
        worst = max(worst, distance / allowed if distance else 0.0)
    word = "within seed scatter" if worst <= 1.0 else "differs"
    return f"{word}: from step {step} on; at the end {worst:.2g} of the scatter"


def _write(file: Path, cases: Mapping[str, Any], variant: str) -> None:
    header = {**records.provenance(), "variant": variant, "processor": _processor()}
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in cases.items())
    file.write_text(f'{{"header": {json.dumps(header)},\n"cases": {{\n{lines}\n}}}}\n')


def _size(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x * x)))


def _cases() -> Iterator[tuple[str, Callable[[int], Trajectory]]]:
    """Every case by name: "problem/method", or "optimizer/name"."""
    for name in OPTIMIZERS:
        yield f"optimizer/{name}", lambda seed, name=name: optimize(name, seed)
    for problem, make in PROBLEMS.items():
        made = cache(make)
        for method in METHODS:
            yield f"{problem}/{method}", lambda seed, made=made, method=method: descend(made(), method, seed)


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.machine())
