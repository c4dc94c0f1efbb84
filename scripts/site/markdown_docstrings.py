"""Docstrings are written for readers of the source: `code` in single backticks, code indented by four columns.

autodoc reads reStructuredText, so both are translated on the way, and what that language would take for markup is escaped.
Sections such as `Args:` are left to napoleon, which comes after.
"""

import re
from typing import Any

from sphinx.application import Sphinx

SECTION = re.compile(r"(Args|Attributes|Raises|Returns|Yields|Note|Notes|Example|Examples):$")
MARKUP = re.compile(r"([*|\\]|_(?=\W|$))")


def _escaped(text: str) -> str:
    """Prose with its `code` as literals, and the rest without any markup."""
    pieces = re.split(r"``?([^`]+)``?", text)
    prose = [MARKUP.sub(r"\\\1", piece) for piece in pieces[::2]]
    code = [f"``{piece}``" for piece in pieces[1::2]]
    for index in range(len(code)):  # a literal ends before a space or a mark; "\\ " is an end that does not show
        if re.match(r"\w", prose[index + 1]):
            prose[index + 1] = "\\ " + prose[index + 1]
        if re.search(r"\w$", prose[index]):
            prose[index] += "\\ "
    return prose[0] + "".join(a + b for a, b in zip(code, prose[1:], strict=True))


def _is_python(block: list[str]) -> bool:
    try:
        compile("\n".join(line[4:] for line in block), "docstring", "exec")
    except SyntaxError:
        return False
    return True


def translated(lines: list[str]) -> list[str]:
    """The lines of a docstring as reStructuredText.

    A code block is what is indented after an empty line, outside sections: those hold indented prose.
    """
    paragraphs = "\n".join(lines).rstrip().split("\n\n")
    result: list[str] = []
    for paragraph in paragraphs:
        block = paragraph.strip("\n").split("\n")
        if block[0].startswith("    ") and not SECTION.match(result[-2] if len(result) > 1 else ""):
            result += [f".. code-block:: {'python' if _is_python(block) else 'text'}", "", *block, ""]
        else:
            result += [*_escaped("\n".join(block)).split("\n"), ""]
    return result


def _process(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    lines[:] = translated(lines)


def setup(app: Sphinx) -> dict[str, bool]:
    """Before napoleon, whose listener has the priority 500."""
    app.connect("autodoc-process-docstring", _process, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
