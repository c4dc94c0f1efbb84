"""Opening the live page in a browser without showing its secret to other users of the machine.

Everyone can read the arguments of a process, so the browser is not handed the page's address: it is handed a file that only its owner can
read, which leads there.
"""

from __future__ import annotations

import contextlib
import html
import os
import shutil
import tempfile
from pathlib import Path

__all__ = ["Redirect"]

_PAGE = """<!doctype html>
<meta charset="utf-8">
<meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0; url={url}">
<title>unrender watch</title>
<p><a href="{url}">The live page</a>
"""


class Redirect:
    """A file that leads a browser to an address, in a folder of its own; both are the owner's alone. A context manager: removed at the end.

    Args:
        url: where it leads.

    Attributes:
        path: of the file.

    Raises `OSError` where it cannot be written.
    """

    def __init__(self, url: str):
        self._folder = Path(tempfile.mkdtemp(prefix="unrender-watch-"))  # mode 0700
        self.path = self._folder / "open.html"
        try:
            found = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(found, "w", encoding="utf-8") as file:
                file.write(_PAGE.format(url=html.escape(url)))
        except BaseException:
            self.remove()
            raise

    def __enter__(self) -> Redirect:
        return self

    def __exit__(self, *error: object) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove it: once the browser has followed it, it is of no more use. Again does nothing."""
        with contextlib.suppress(OSError):
            shutil.rmtree(self._folder)
