"""The errors a caller may catch. Each carries one line that says what is wrong and what would be right."""

from unrender.core.text import one_line


class UnrenderError(Exception):
    """Base of every error that `unrender` raises on purpose.

    Its text is one printable line of bounded length, whatever names went into it: control characters are written as escapes.
    """

    def __init__(self, *arguments: object):
        super().__init__(*(one_line(part) if isinstance(part, str) else part for part in arguments))


class InputError(UnrenderError, ValueError):
    """What the user gave is wrong: a file, a field, a name, a value. The command line exits with 2."""


class VariantError(UnrenderError, RuntimeError):
    """This machine cannot run what was asked: no usable LLVM, no GPU, an unknown variant. The command line exits with 3."""
