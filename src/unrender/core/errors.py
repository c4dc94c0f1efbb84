"""The errors a caller may catch. Each carries one line that says what is wrong and what would be right."""

__all__ = ["InputError", "UnrenderError", "VariantError"]


class UnrenderError(Exception):
    """Base of every error that `unrender` raises on purpose."""


class InputError(UnrenderError, ValueError):
    """What the user gave is wrong: a file, a field, a name, a value. The command line exits with 2."""


class VariantError(UnrenderError, RuntimeError):
    """This machine cannot run what was asked: no usable LLVM, no GPU, an unknown variant. The command line exits with 3."""
