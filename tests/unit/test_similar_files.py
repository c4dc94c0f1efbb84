"""Files that are missing: a similar name in the folder is proposed."""

from __future__ import annotations

from pathlib import Path

import pytest

from unrender.io.bounded_files import no_file


def test_only_problem_files_are_proposed_for_one(tmp_path: Path) -> None:
    """The scene room.xml was proposed for room.toml."""
    (tmp_path / "room.xml").touch()
    assert no_file(tmp_path / "room.toml") == "no such file"
    assert no_file(tmp_path / "room.xm") == "no such file; did you mean room.xml?"


@pytest.mark.parametrize(
    ("name", "near"), [("rom.png", "room.png"), ("room.exr", "room.png"), ("m.png", ""), ("cm.png", "cmp.png")]
)
def test_names_that_share_only_their_ending_are_not_proposed(tmp_path: Path, name: str, near: str) -> None:
    for present in ("room.png", "cmp.png"):
        (tmp_path / present).touch()
    assert no_file(tmp_path / name) == f"no such file{f'; did you mean {near}?' if near else ''}"
