"""Checks of a scene's spectrum files (`.spd`, lines of a wavelength and a value) before Mitsuba reads them."""

from __future__ import annotations

from pathlib import Path

from unrender.core.errors import InputError
from unrender.io import bounded_files

_LARGEST = 1 << 20


def check(path: Path) -> None:
    """Raise `InputError` unless the file is such a spectrum."""
    text = bounded_files.read_text(path, _LARGEST)
    for number, line in enumerate(text.split("\n"), 1):
        words = line.partition("#")[0].split()
        try:
            if len(words) not in (0, 2):
                raise ValueError
            for word in words:
                float(word)
        except ValueError as error:
            raise InputError(f"{path}:{number}: expected a wavelength and a value") from error
