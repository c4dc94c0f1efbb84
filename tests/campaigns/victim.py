"""A process whose children carry out commands of `unrender`, each forked off with everything imported, and are killed.

    python -m tests.campaigns.victim < one JSON object a line > the child's process id, then its exit status, each on a line

An order holds "words", the command's; "watch" and "at", a folder and the number of the file operation below it that kills; and "count",
a file that gets the operations, one a line. None of the children's threads is there before the fork.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import pkgutil
import sys
from pathlib import Path
from typing import Any

__all__ = ["main"]


def carry_out(order: dict[str, Any]) -> int:
    """One command."""
    from tests.campaigns.faults import die, operations
    from unrender.app.cli.main import main as unrender

    words = [str(word) for word in order["words"]]
    if "watch" not in order:
        return unrender(words)
    with operations(Path(order["watch"]), order.get("at"), die) as seen:
        status = unrender(words)
    if "count" in order:
        Path(order["count"]).write_text("\n".join(seen))
    return status


def import_all() -> None:
    """Import what takes seconds to import, once, but for what needs a variant in use, which starts threads."""
    import unrender
    from unrender.core.errors import InputError

    for module in pkgutil.walk_packages(unrender.__path__, "unrender."):
        if "integrators" not in module.name and not module.name.endswith("__main__"):
            with contextlib.suppress(ImportError, AttributeError, InputError):
                importlib.import_module(module.name)


def main() -> None:
    """Fork a child for each line of the input."""
    from unrender.backend import variant

    variant.prepare()
    import_all()
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            status = 1
            try:
                out = os.open(os.devnull, os.O_WRONLY)
                os.dup2(out, 1)
                status = carry_out(json.loads(line))
            finally:
                sys.stderr.flush()
                os._exit(status)
        print(child, flush=True)
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    main()
