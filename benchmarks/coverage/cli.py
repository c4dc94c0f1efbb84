"""`python -m benchmarks coverage`: write the pages on Mitsuba's plugins."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import unrender as ur

__all__ = ["main"]


def main(arguments: Sequence[str]) -> int:
    """Do what the command line says; the exit status."""
    parser = argparse.ArgumentParser("python -m benchmarks coverage", description=__doc__)
    parser.add_argument("--ranges", action="store_true", help="write docs/reference/ranges.md alone")
    parser.parse_args(arguments)
    ur.use()
    from benchmarks.coverage import ranges_page

    ranges_page.PAGE.write_text(ranges_page.page())
    print(f"wrote {ranges_page.PAGE}")
    return 0
