"""Run folders made by somebody who means harm: each is refused in one line, nothing is executed, and nothing written elsewhere."""

from __future__ import annotations

import io
import json
import os
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_folders import KEY, Page, write_run

from unrender.app import report
from unrender.app.watch.monitor import RunMonitor
from unrender.core.errors import InputError
from unrender.io import bounded_files
from unrender.runs.folder import history

GOOD = np.ones((4, 5, 3), np.float32)
Break = Callable[[Path], Any]


def npy(header: str | bytes, data: bytes = b"", version: tuple[int, int] = (1, 0)) -> bytes:
    """An .npy file with whatever header."""
    text = header.encode() if isinstance(header, str) else header
    size = struct.pack("<H" if version == (1, 0) else "<I", len(text) + 1)
    return b"\x93NUMPY" + bytes(version) + size + text + b"\n" + data


def shape(text: str, kind: str = "<f4") -> str:
    return f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {text}, }}"


def archive(name: str, **members: bytes) -> Break:
    """Write an .npz with these members, as they are."""

    def write(run: Path) -> None:
        with zipfile.ZipFile(run / name, "w", zipfile.ZIP_DEFLATED) as file:
            for member, data in members.items():
                file.writestr(f"{member}.npy", data)

    return write


def named(member: str) -> Break:
    """parameters.npz with one good array of this name."""
    buffer = io.BytesIO()
    np.save(buffer, GOOD)

    def write(run: Path) -> None:
        with zipfile.ZipFile(run / "parameters.npz", "w") as file:
            file.writestr(member, buffer.getvalue())

    return write


def twice(run: Path) -> None:
    np.savez(run / "truth.npz", a=GOOD)
    with zipfile.ZipFile(run / "truth.npz", "a") as file, pytest.warns(UserWarning, match="Duplicate"):
        file.writestr("a.npy", zipfile.ZipFile(run / "truth.npz").read("a.npy"))


def corrupt(run: Path) -> None:
    """One bit of an array is another one, and its checksum tells."""
    np.savez(run / "truth.npz", a=np.zeros(1000))
    data = bytearray((run / "truth.npz").read_bytes())
    data[4000] ^= 1
    (run / "truth.npz").write_bytes(data)


def cut(name: str, share: float) -> Break:
    def write(run: Path) -> None:
        data = (run / name).read_bytes()
        (run / name).write_bytes(data[: int(len(data) * share)])

    return write


def put(name: str, data: bytes | str) -> Break:
    return lambda run: (run / name).write_bytes(
        data.encode("utf-8", "surrogatepass") if isinstance(data, str) else data
    )


def change(**fields: Any) -> Break:
    def write(run: Path) -> None:
        found = json.loads((run / "run.json").read_text())
        (run / "run.json").write_text(json.dumps(found | fields))

    return write


def line(text: str) -> Break:
    def write(run: Path) -> None:
        with (run / "history.jsonl").open("a") as file:
            file.write(text + "\n")

    return write


def linked(name: str) -> Break:
    """A link out of the folder, to a file of the right kind."""

    def write(run: Path) -> None:
        elsewhere = run.parent / "elsewhere"
        elsewhere.mkdir()
        (run / name).rename(elsewhere / name)
        (run / name).symlink_to(elsewhere / name)

    return write


def replaced(name: str, by: Callable[[Path], Any]) -> Break:
    def write(run: Path) -> None:
        (run / name).unlink()
        by(run / name)

    return write


def pictures(**kinds: np.ndarray) -> Break:
    named: dict[str, Any] = {f"view0/{kind}": array for kind, array in kinds.items()}
    return lambda run: np.savez(run / "pictures.npz", **named)


def packed(method: int, spoil: bool = False) -> Break:
    """truth.npz packed in some way, and then perhaps not what its packer wrote."""

    def write(run: Path) -> None:
        with zipfile.ZipFile(run / "truth.npz", "w", method) as file:
            file.writestr("a.npy", npy(shape("(1000,)"), np.random.default_rng(0).bytes(4000)))
        data = bytearray((run / "truth.npz").read_bytes())
        data[600:700] = bytes(100) if spoil else data[600:700]
        (run / "truth.npz").write_bytes(data)

    return write


def deep(levels: int) -> Any:
    found: Any = 1
    for _ in range(levels):
        found = {"a": found}
    return found


NOT_AN_ARCHIVE = "not an .npz archive that can be read"
PICKLE = b"cos\nsystem\n(S'touch owned'\ntR."
RECORDS = "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }"
HOSTILE: dict[str, tuple[Break, str]] = {
    # Archives
    "an absurd shape": (archive("parameters.npz", a=npy(shape("(1000000000, 1000000000)"))), "declares the shape"),
    "a shape beyond 64 bits": (archive("parameters.npz", a=npy(shape(f"({2**62}, {2**62}, {2**62})"))), "declares the shape"),
    "a shape that overflows to what is there": (archive("truth.npz", a=npy(shape(f"({2**32}, {2**32})"), b"")), "declares the shape"),
    "a negative side": (archive("parameters.npz", a=npy(shape("(-4, 5)"), bytes(80))), "cannot have the shape"),
    "a side in words": (archive("parameters.npz", a=npy(shape("('4', 5)"), bytes(80))), NOT_AN_ARCHIVE),
    "a hundred sides": (archive("parameters.npz", a=npy(shape("(" + "1, " * 100 + ")"), bytes(4))), "cannot have the shape"),
    "more data than declared": (archive("truth.npz", a=npy(shape("(4,)"), bytes(400))), "declares the shape"),
    "less data than declared": (archive("truth.npz", a=npy(shape("(400,)"), bytes(4))), "declares the shape"),
    "a pickle": (archive("truth.npz", a=npy(shape("(1,)", "|O"), PICKLE)), "expected real numbers, got object"),
    "a pickle by itself": (put("truth.npz", PICKLE), NOT_AN_ARCHIVE),
    "an array of objects": (lambda run: np.savez(run / "truth.npz", a=np.array([{}], object)), "expected real numbers"),
    "records": (archive("truth.npz", a=npy(RECORDS, bytes(4))), "expected real numbers"),
    "complex numbers": (lambda run: np.savez(run / "truth.npz", a=np.ones(3, complex)), "expected real numbers"),
    "a header that is a program": (archive("truth.npz", a=npy("__import__('os').system('touch owned')")), NOT_AN_ARCHIVE),
    "a header without end": (archive("truth.npz", a=npy("(" * 9000)), NOT_AN_ARCHIVE),
    "a header of a gigabyte": (archive("truth.npz", a=b"\x93NUMPY\x02\x00\x00\x00\x00\x40"), NOT_AN_ARCHIVE),
    "a version that is not": (archive("truth.npz", a=npy(shape("(1,)"), bytes(4), (9, 9))), "version 1 or 2"),
    "no array": (archive("truth.npz", a=b"hello"), NOT_AN_ARCHIVE),
    "nothing inside": (archive("truth.npz", a=b""), NOT_AN_ARCHIVE),
    "cut in half": (cut("pictures.npz", 0.5), NOT_AN_ARCHIVE),
    "cut by a byte": (cut("parameters.npz", 0.999), NOT_AN_ARCHIVE),
    "another bit": (corrupt, NOT_AN_ARCHIVE),
    "a stream that does not unpack": (packed(zipfile.ZIP_DEFLATED, spoil=True), NOT_AN_ARCHIVE),
    "an unusual packer": (packed(zipfile.ZIP_LZMA), NOT_AN_ARCHIVE),
    "an array twice": (twice, "given twice"),
    "a path upwards": (named("../../../tmp/owned.npy"), "a name that leads out of the archive"),
    "a path from the root": (named("/etc/owned.npy"), "a name that leads out of the archive"),
    "a path for another system": (named("..\\owned.npy"), "a name that leads out of the archive"),
    "an encrypted member": (archive("truth.npz", a=npy(shape("(1,)"), bytes(4))), NOT_AN_ARCHIVE),
    # JSON
    "a number for a name": (change(name=5), "name: expected a valid string, got 5"),
    "words for warnings": (change(warnings="none"), "warnings: expected a valid list"),
    "a list for settings": (change(settings=[1]), "settings: expected a valid dictionary"),
    "steps beyond counting": (put("run.json", '{"name": "a", "method": "b", "steps": 1' + "0" * 400 + "}"), r"run\.json: steps"),
    "steps that cannot be written": (put("run.json", '{"name": "a", "method": "b", "steps": 1' + "0" * 5000 + "}"), r"run\.json"),
    "seconds that are no number": (put("run.json", '{"name": "a", "method": "b", "seconds": NaN}'), r"run\.json: seconds"),
    "half a character": (change(name="\ud800"), "holds text that is no Unicode"),
    "half a character as a key": (change(settings={"\udfff": 1}), "holds text that is no Unicode"),
    "settings without floor": (change(settings=deep(500)), "nested more than"),
    "settings deeper than Python": (put("run.json", '{"name": "a", "method": "b", "settings": ' + '{"a":' * 100_000), r"run\.json"),
    "twenty megabytes of JSON": (put("run.json", '{"name": "' + "a" * (20 << 20) + '"}'), "larger than 16 MiB"),
    # History
    "a line of two megabytes": (line('{"seconds": 9, "samples": 900, "note": "' + "a" * (2 << 20) + '"}'), "a line of more than 1 MiB"),
    "two megabytes without a line": (put("history.jsonl", "a" * (2 << 20)), "a line of more than 1 MiB"),
    "a time that is no number": (line('{"seconds": NaN, "samples": 900}'), "expected a finite number, got nan"),
    "a time without end": (line('{"seconds": Infinity, "samples": 900}'), "expected a finite number, got inf"),
    "a negative time": (put("history.jsonl", '{"seconds": -1, "samples": 0}'), "expected no less than 0"),
    "a list of errors": (line('{"seconds": 9, "samples": 900, "parameter_error": [1]}'), "expected an object"),
    "a deep line": (line('{"seconds": 9, "samples": 900, "a": ' + "[" * 60 + "]" * 60 + "}"), "nested more than"),
    "no text": (put("history.jsonl", b"\xff\xfe"), "not UTF-8"),
    # Places
    "run.json from elsewhere": (linked("run.json"), "leads out of the folder"),
    "an archive from elsewhere": (linked("parameters.npz"), "leads out of the folder"),
    "a history from elsewhere": (linked("history.jsonl"), "leads out of the folder"),
    "a link to nothing": (replaced("truth.npz", lambda path: path.symlink_to("nothing")), "no such file"),
    "a link to itself": (replaced("truth.npz", lambda path: path.symlink_to("truth.npz")), "cannot be read"),
    "a device": (replaced("truth.npz", lambda path: path.symlink_to("/dev/zero")), "leads out of the folder"),
    "a pipe": (replaced("history.jsonl", os.mkfifo), "not a regular file"),
    "a folder": (replaced("initial.npz", Path.mkdir), "a folder, expected a file"),
    # Pictures
    "a picture of nothing": (pictures(reference=GOOD[:0], result=GOOD[:0]), "expected shape"),
    "a probability of another size": (
        pictures(reference=GOOD, result=GOOD, pixel_probability=np.ones((9, 9))), "expected the reference's shape",
    ),
}  # fmt: skip


def encrypt(run: Path) -> None:
    """Mark the member as encrypted, in both of its headers."""
    data = bytearray((run / "truth.npz").read_bytes())
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        data[data.index(mark) + offset] |= 1
    (run / "truth.npz").write_bytes(data)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_folder_is_refused_in_one_line(tmp_path, monkeypatch, name):
    """By the report, and by the live page, which tells it and goes on."""
    monkeypatch.chdir(tmp_path)
    run = write_run(tmp_path / "run")
    break_it, message = HOSTILE[name]
    break_it(run)
    if name == "an encrypted member":
        encrypt(run)
    before = sorted(path for path in tmp_path.rglob("*"))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=message) as raised:
            report.page(run)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert "\n" not in str(raised.value)
    assert str(run) in str(raised.value)
    assert len(str(raised.value)) < 600
    assert peak < 200 << 20
    snapshot = RunMonitor(run).snapshot()
    assert any(str(run) in line for line in snapshot.problems)
    assert sorted(path for path in tmp_path.rglob("*")) == before  # neither a page nor anything else
    assert not Path("owned").exists()


def test_there_are_as_many_as_are_promised():
    assert len(HOSTILE) >= 50


def test_an_archive_that_unpacks_to_more_than_memory_holds_is_not_unpacked(tmp_path):
    """A kilobyte that says it is ten gigabytes; and one whose zeros truly are many, beyond what one array may be."""
    run = write_run(tmp_path / "run")
    archive("truth.npz", a=npy(shape("(1,)"), bytes(4)))(run)
    data = bytearray((run / "truth.npz").read_bytes())
    at = data.index(b"PK\x01\x02") + 24
    data[at : at + 4] = struct.pack("<I", 0xFFFFFFF0)
    (run / "truth.npz").write_bytes(data)
    with pytest.raises(InputError, match=r"declares the shape|archive"):
        report.page(run)
    limit = bounded_files.LARGEST_ARRAY // 4 + 1
    archive("truth.npz", a=npy(shape(f"({limit},)"), bytes(1 << 20)))(run)
    with pytest.raises(InputError, match="declares the shape"):
        report.page(run)


def test_a_history_of_more_than_a_gigabyte_is_not_read(tmp_path):
    run = write_run(tmp_path / "run")
    with (run / "history.jsonl").open("r+b") as file:
        file.truncate(history.LARGEST + 1)  # a hole: it takes no room
    with pytest.raises(InputError, match="larger than 1 GiB"):
        report.page(run)


ODD = "\u202eevil\u0000\n\t</script><script>alert(1)</script>"


def test_odd_names_and_numbers_make_a_page_and_no_harm(tmp_path):
    """Names that turn text around, end lines or the page; values that overflow. They are data, and are shown."""
    values = np.array([np.nan, np.inf, -np.inf, 3e38] + [1.0] * 56, np.float32).reshape(4, 5, 3)
    run = write_run(
        tmp_path / "run",
        truth={ODD.replace("\0", ""): values},
        initial={ODD.replace("\0", ""): -values},
        parameters={ODD.replace("\0", ""): values[::-1]},
        views={f"view0/{kind}": values * sign for kind, sign in (("reference", 1), ("result", -1), ("initial", 1))},
        warnings=[ODD],
        name=ODD,
        loss=(1.0, float("inf"), None, 1e308),
    )
    page = Page(report.page(run))
    assert page.dangers() == []
    other = write_run(tmp_path / "other", "rcv", truth={"a": GOOD})
    with pytest.raises(InputError, match="another problem") as raised:
        report.compare([other, run], tmp_path / "out")
    assert "\n" not in str(raised.value)


def test_an_empty_array_is_no_map(tmp_path):
    shapes = [(0,), (0, 5, 3), (5, 0, 3), (0, 5, 5, 3), (5, 5, 0)]
    arrays = {f"p{i}": np.zeros(shape) for i, shape in enumerate(shapes)}
    assert report.page(write_run(tmp_path / "run", truth=arrays, parameters=arrays, initial=arrays)).exists()


def test_a_page_replaces_a_link_and_does_not_write_through_it(tmp_path):
    run = write_run(tmp_path / "run")
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    (run / "report.html").symlink_to(mine)
    report.page(run)
    assert mine.read_text() == "mine"


def test_a_good_folder_reached_by_a_link_is_read(tmp_path):
    """Of the folder itself, and of a file within it."""
    run = write_run(tmp_path / "run")
    (run / "kept.npz").write_bytes((run / "truth.npz").read_bytes())
    (run / "truth.npz").unlink()
    (run / "truth.npz").symlink_to("kept.npz")
    (tmp_path / "link").symlink_to(run)
    assert KEY in Page(report.page(tmp_path / "link")).words


@pytest.mark.mitsuba
@pytest.mark.parametrize("where", ["label", "notice", "error"])
def test_a_terminal_is_not_told_what_to_do(tmp_path, capsys, monkeypatch, where):
    """Escape sequences in names: they could move the cursor, retitle the window, or hide what went before."""
    from unrender.app.cli.main import main

    monkeypatch.chdir(tmp_path)
    evil = "\x1b]0;owned\x07\x1b[2J"
    fields: dict[str, Any] = {"warnings": [evil]} if where == "notice" else {}
    runs = [write_run(tmp_path / name, name + (evil if where == "label" else ""), **fields) for name in ("a", "b")]
    if where == "error":
        line(json.dumps({"seconds": 9, "samples": 900, "parameter_error": {evil: "x"}}))(runs[0])
    status = main(["compare", *map(str, runs)])
    said = capsys.readouterr()
    assert status == (2 if where == "error" else 0)
    assert "owned" in said.out + said.err
    assert "\x1b]" not in said.out + said.err
    assert "\x1b[2J" not in said.out + said.err
