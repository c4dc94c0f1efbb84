"""What --workers of one run refuses, before anything takes time."""

from __future__ import annotations

from typing import Any

import pytest

from unrender.cli.main import main


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--workers", "two"], "--workers two: expected auto, a number, the address HOST:PORT"),
        (["--workers", "0"], "--workers 0: expected"),
        (
            ["--workers", "1", "--compress"],
            "--compress: is of what is sent to workers; --workers 1 is this process alone",
        ),
        (["--compress"], "--compress: is of what is sent to workers; give --workers, too"),
    ],
)
def test_bad_words_are_one_line(words: list[str], line: str, capfd: Any, tmp_path: Any) -> None:
    assert main(["run", "indirect-room", *words, "--out", str(tmp_path / "out")]) == 2
    told = capfd.readouterr().err
    assert line in told
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()
