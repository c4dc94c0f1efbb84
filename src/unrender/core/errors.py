"""Errors that a caller may catch. Each message is one line: what is wrong, and what was expected."""

from collections.abc import Iterator
from contextlib import contextmanager

from unrender.core.text import one_line


class UnrenderError(Exception):
    """Base class of every error that `unrender` raises on purpose.

    The message is one printable line of at most `core.text.LONGEST_LINE` characters. Control characters are escaped.
    """

    def __init__(self, *arguments: object):
        super().__init__(*(one_line(part) if isinstance(part, str) else part for part in arguments))

    def _render_traceback_(self) -> list[str]:
        """Return what a notebook prints in place of a traceback: one line. IPython looks for this name."""
        return [f"{type(self).__name__}: {self}"]


class InputError(UnrenderError, ValueError):
    """Invalid input from the user: a file, a field, a name or a value. The command line exits with 2."""


@contextmanager
def prefixed(where: object) -> Iterator[None]:
    """Begin the message of an `InputError` of the statements inside with `where` and a colon; "" leaves it unchanged."""
    try:
        yield
    except InputError as error:
        if where == "":
            raise
        raise InputError(f"{where}: {error}") from error


class KeyedError(InputError):
    """Invalid input about one key; `what` is one line without it."""

    def __init__(self, key: str, what: str):
        super().__init__(what)
        self.key = key


class UnknownOptionError(InputError):
    """An option that no method has."""


class VariantError(UnrenderError, RuntimeError):
    """Missing capability of the machine: no usable LLVM, no GPU, an unknown variant. The command line exits with 3."""
