"""Where the `unrender` command begins: what must be right before anything imports Mitsuba."""

from __future__ import annotations

import sys

from unrender import variant
from unrender.errors import VariantError

ENVIRONMENT = 3


def main() -> int:
    """Run the command line. Returns its exit status; 3, after one line, where Dr.Jit cannot even be imported."""
    try:
        variant.prepare()
    except VariantError as error:
        print(f"unrender: {error}", file=sys.stderr)
        return ENVIRONMENT
    from unrender.cli.main import main as command_line

    return command_line()
