"""python -m benchmarks gpu                    the plan's slices, and what became of each
python -m benchmarks gpu --next            run the next one that has not been done
python -m benchmarks gpu --slice A B       run these
python -m benchmarks gpu --toy             run the whole plan at toy sizes, on whatever there is
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Iterator, Sequence

from benchmarks.gpu.execute import run_slice
from benchmarks.gpu.plan import FULL, SLICES, TOY, Folder, Slice, device
from unrender.backend import variant


def main(arguments: Sequence[str]) -> int:
    """Do what the command line says; the exit status: 1 where a slice was not done, 2 where none can run."""
    parser = argparse.ArgumentParser(
        "python -m benchmarks gpu", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--slice", nargs="+", metavar="NAME", choices=[part.name for part in SLICES], default=())
    parser.add_argument("--next", action="store_true", help="the first slice that was never run to its end")
    parser.add_argument("--toy", action="store_true", help="toy sizes, on the processor where no GPU works")
    parser.add_argument("--minutes", type=float, default=10.0, help="for a slice; what goes on is ended (10)")
    parser.add_argument("--again", action="store_true", help="what has ended, too")
    parser.add_argument("--list", action="store_true", help="only list; with --toy, what became of the toy plan")
    given = parser.parse_args(arguments)
    folder = TOY if given.toy else FULL
    chosen = [] if given.list else _chosen(given, folder)
    if not chosen:
        print(*lines(folder), sep="\n")
        return 0
    problem = variant.gpu_problem()
    if problem is not None and not given.toy:
        print(f"no GPU works here: {problem}; --toy runs the plan on the processor", file=sys.stderr)
        return 2
    where, ends = device(problem is None), []
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the command that runs is ended, too
    try:
        for part in chosen:
            if given.again:
                folder.forget(part)
            ends.append(run_slice(part, folder, where, given.minutes))
    finally:
        signal.signal(signal.SIGTERM, before)
    for part, end in zip(chosen, ends, strict=True):
        print(f"{part.name}: {end}")
    return 0 if all(end == "done" for end in ends) else 1


def _chosen(given: argparse.Namespace, folder: Folder) -> list[Slice]:
    if given.slice:
        return [part for part in SLICES if part.name in given.slice]
    if given.next:
        return [part for part in SLICES if folder.is_next(part)][:1]
    return list(SLICES) if given.toy else []


def lines(folder: Folder) -> Iterator[str]:
    """Yield a line per slice: name, state, minutes spent or expected, what it shows, and when and where it ran."""
    width = max(len(part.name) for part in SLICES)
    for part in SLICES:
        state = folder.read(part)
        spent = sum(entry["seconds"] for entry in state.get("commands", {}).values()) / 60
        time = f"{spent:.1f} min" if state else f"~{part.minutes:.0f} min"
        where = f", {state['date']}, {state['device']['name']}" if state else ""
        yield f"{part.name:{width}}  {folder.summary(part):11}  {time:>8}  {part.what}{where}"
