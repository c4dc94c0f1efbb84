"""The one command of all benchmarks.

python -m benchmarks                       list them
python -m benchmarks NAME [options]        run one; `--help` tells its options
python -m benchmarks results               write a page per benchmark, with figures, to docs/benchmarks
python -m benchmarks gpu                   the plan for a GPU, in slices; `--help` tells its options
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.runner import records
from benchmarks.runner.catalogue import ROOT, Benchmark, benchmarks
from benchmarks.runner.machine import Load
from benchmarks.runner.options import add_options, defaults
from benchmarks.runner.records import Record, scratch
from unrender.io import confinement


def main(arguments: Sequence[str]) -> int:
    """Do what the command line says; the exit status."""
    known = benchmarks()
    if not arguments or arguments[0] in ("-h", "--help"):
        print((__doc__ or "").partition("\n\n")[2])
        width = max(map(len, known))
        for name, benchmark in known.items():
            print(f"{name:{width}}  {benchmark.summary}")
        return 0
    if arguments[0] == "results":
        from benchmarks.runner.results_page import write_pages

        print(f"wrote {write_pages()}")
        return 0
    if arguments[0] == "gpu":
        from benchmarks.gpu import cli as gpu

        return gpu.main(arguments[1:])
    if arguments[0] not in known:
        print(f"no benchmark {arguments[0]!r}; python -m benchmarks lists them", file=sys.stderr)
        return 2
    return execute(known[arguments[0]], arguments[1:])


def execute(benchmark: Benchmark, arguments: Sequence[str]) -> int:
    """Measure and plot one benchmark, or plot its record."""
    module = benchmark.module
    parser = argparse.ArgumentParser(
        f"python -m benchmarks {benchmark.name}",
        description=benchmark.docstring,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    own = parser.add_argument_group("of every benchmark")
    own.add_argument("--quick", action="store_true", help="toy sizes, to see that it works; written below out/")
    own.add_argument("--plots-only", action="store_true", help="draw the figure from the record, measure nothing")
    own.add_argument("--out", type=Path, help="folder of the record and the figure (the benchmark's own)")
    names = add_options(parser, module.run)
    if "--plots-only" in arguments:  # then no argument by position is asked for
        given = parser.parse_args([*arguments, *([str(Path())] * (len(names) - len(defaults(module.run))))])
    else:
        given = parser.parse_args(arguments)
    folder = given.out or (scratch(f"quick/{benchmark.name}") if given.quick else benchmark.folder)
    if not given.plots_only:
        import unrender as ur

        asked = {name: getattr(given, name) for name in names if hasattr(given, name)}
        settings = {**defaults(module.run), **(module.QUICK if given.quick else {}), **asked}
        try:
            measure(benchmark, settings, folder, keep=not given.quick)
        except ur.InputError as error:
            print(error, file=sys.stderr)
            return 2
    record = records.read(folder)
    if record is None:
        print(f"no results.json in {folder}", file=sys.stderr)
        return 2
    draw(benchmark, record, folder / "figure.png")
    print(benchmark.table(record))
    return 0


def measure(benchmark: Benchmark, settings: dict[str, Any], folder: Path, keep: bool = True) -> None:
    """Run, and write the record after every part that `run` yields.

    Args:
        settings: the arguments of `run`.
        keep: whether entries of the record on file that were not measured again stay, where the module names them (`MERGE`).
    """
    import unrender as ur

    module = benchmark.module
    if getattr(module, "RENDERS", True):
        print(f"variant {ur.use()}", flush=True)
    load = Load()
    with confinement.within(Path(ROOT.anchor)):  # scenes are the project's own, or of a folder that an option names
        found = module.run(**settings)
        for part in found if isinstance(found, Iterator) else (found,):
            record: Record = {**records.provenance(), "load": load.after(), "settings": _plain(settings), **part}
            old = records.read(folder) if keep else None
            keep = True
            if old is not None:
                for path in getattr(module, "MERGE", ()):
                    record = records.merge(old, record, path.split("."))
            if hasattr(module, "summarize"):
                record |= module.summarize(record)
            records.write(folder, record)


def draw(benchmark: Benchmark, record: Record, file: Path) -> bool:
    """Write the figure of a record. Return whether it could be drawn: some figures need images that a record may lack."""
    import matplotlib.pyplot as plt

    plt.switch_backend("Agg")
    plot = benchmark.plot
    if plot is None:
        return False
    try:
        figure = plot(record)
    except KeyError as error:
        if "maps" in record or error.args != ("maps",):
            raise
        print("no figure: this record keeps no images", file=sys.stderr)
        return False
    if figure is None:
        return False
    figure.savefig(file, dpi=100)
    plt.close(figure)
    print(f"wrote {file}", flush=True)
    return True


def _plain(settings: dict[str, Any]) -> Record:
    return {name: str(value) if isinstance(value, Path) else value for name, value in settings.items()}
