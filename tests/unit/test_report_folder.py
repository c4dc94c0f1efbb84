"""Malformed run folders: each is one line that names the file and the field."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_folders import KEY, write_run

from unrender.app import report
from unrender.core.errors import InputError


def _json(name: str, **change: Any):
    def break_it(run: Path) -> None:
        found = json.loads((run / name).read_text()) | change
        (run / name).write_text(json.dumps({k: v for k, v in found.items() if v is not ...}))

    return break_it


def _line(number: int, text: str):
    def break_it(run: Path) -> None:
        lines = (run / "history.jsonl").read_text().splitlines()
        lines[number - 1] = text
        (run / "history.jsonl").write_text("\n".join(lines))

    return break_it


def _bytes(name: str, data: bytes | None):
    def break_it(run: Path) -> None:
        (run / name).unlink() if data is None else (run / name).write_bytes(data)

    return break_it


def _arrays(name: str, **arrays: Any):
    return lambda run: np.savez(run / name, **arrays)


GOOD = np.ones((2, 2, 3), np.float32)
MALFORMED = {
    "no run.json": (_bytes("run.json", None), "run.json is missing"),
    "empty run.json": (_bytes("run.json", b""), r"run\.json: not JSON"),
    "broken run.json": (_bytes("run.json", b'{\n"name": }'), r"run\.json:2: not JSON"),
    "a list": (_bytes("run.json", b"[]"), r"run\.json: expected an object"),
    "deep nesting": (_bytes("run.json", b"[" * 200_000), r"run\.json: not JSON"),
    "not text": (_bytes("run.json", b"\xff\xfe{}"), r"run\.json: not UTF-8"),
    "no method": (_json("run.json", method=...), r"run\.json: method is missing"),
    "misspelt method": (_json("run.json", method=..., metod="rcv"), "did you mean metod"),
    "seed in words": (_json("run.json", seed="zero"), r"run\.json: seed: expected .*integer.*'zero'"),
    "negative steps": (_json("run.json", steps=-1), r"run\.json: steps: .*-1"),
    "infinite seconds": (_json("run.json", seconds=float("inf")), r"run\.json: seconds: .*finite"),
    "no history": (_bytes("history.jsonl", None), r"history\.jsonl: no such file"),
    "cut history": (_line(3, '{"step": 2, "sec'), r"history\.jsonl:3: not JSON"),
    "no seconds": (_line(2, '{"samples": 5}'), r"history\.jsonl:2: seconds: expected a number, got nothing"),
    "samples in words": (_line(2, '{"seconds": 2, "samples": "5"}'), r"history\.jsonl:2: samples: .*'5'"),
    "true seconds": (_line(1, '{"seconds": true, "samples": 5}'), r"history\.jsonl:1: seconds: .*True"),
    "time runs back": (_line(3, '{"seconds": 0.5, "samples": 900}'), r"history\.jsonl:3: seconds: .*0\.5"),
    "huge number": (_line(1, '{"seconds": 1' + "0" * 400 + ', "samples": 1}'), r"history\.jsonl:1: seconds: .*finite"),
    "error as number": (
        _line(1, '{"seconds": 1, "samples": 1, "parameter_error": 3}'),
        r"history\.jsonl:1: parameter_error: expected an object",
    ),
    "error in words": (
        _line(1, '{"seconds": 1, "samples": 1, "parameter_error": {"k": "low"}}'),
        r"history\.jsonl:1: parameter_error\.k: expected a number, got 'low'",
    ),
    "no parameters": (_bytes("parameters.npz", None), r"parameters\.npz: the file is missing"),
    "not an archive": (_bytes("parameters.npz", b"hello"), r"parameters\.npz: .*archive"),
    "cut archive": (_bytes("parameters.npz", b"PK\x03\x04 and no more"), r"parameters\.npz: .*archive"),
    "empty archive": (_bytes("truth.npz", b""), r"truth\.npz: .*archive"),
    "pickled objects": (
        _arrays("truth.npz", a=np.array([{}], object)),
        r"truth\.npz: a: expected real numbers, got object",
    ),
    "words as values": (
        _arrays("initial.npz", **{KEY: np.array(["a"])}),
        rf"initial\.npz: {KEY}: expected real numbers",
    ),
    "other keys": (
        _arrays("initial.npz", **{KEY[:-1]: GOOD}),
        rf"initial\.npz: {KEY} is missing; did you mean {KEY[:-1]}",
    ),
    "no reference": (_arrays("pictures.npz", **{"view0/result": GOOD}), r"pictures\.npz: view0/reference is missing"),
    "grey picture": (_arrays("pictures.npz", **{"view0/reference": GOOD[..., 0]}), r"view0/reference: expected shape"),
    "other size": (
        _arrays("pictures.npz", **{"view3/reference": GOOD, "view3/result": np.ones((2, 3, 3))}),
        r"view3/result: expected the reference's shape \(2, 2, 3\), got \(2, 3, 3\)",
    ),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_folder_is_one_line_with_file_and_field(tmp_path, name):
    run = write_run(tmp_path / "run")
    break_it, message = MALFORMED[name]
    report.page(run).unlink()  # as written it is fine
    break_it(run)
    with pytest.raises(InputError, match=message) as raised:
        report.page(run)
    assert "\n" not in str(raised.value)
    assert str(run) in str(raised.value)
    assert not (run / "report.html").exists()


def test_a_missing_folder_names_the_nearest(tmp_path):
    write_run(tmp_path / "lamp-rcv")
    with pytest.raises(InputError, match="did you mean lamp-rcv"):
        report.page(tmp_path / "lamp-rvc")
    with pytest.raises(InputError, match=r"run folders inside it: lamp-rcv"):
        report.page(tmp_path)
