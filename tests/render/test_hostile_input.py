"""Run folders, problems and pictures that are malformed on purpose: one line each, nothing executed, nothing written elsewhere."""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unrender as ur
from unrender.core.errors import InputError
from unrender.io import bounded_files, images, scene_files
from unrender.runs.folder import checkpoint

_CANARY = "unrender_canary_that_no_module_is_called"


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with one checkpoint, stopped half-way."""
    folder = tmp_path_factory.mktemp("hostile") / "run"
    ur.optimize(_problem(), ur.PathGradient(spp=2), ur.optimizers.Adam(), steps=4, run_directory=folder)
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**record, "status": "interrupted"}))
    return folder


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """A copy of it, which may be spoilt."""
    copy = tmp_path / "run"
    for path in original.rglob("*"):
        if path.is_file():
            (copy / path.relative_to(original)).parent.mkdir(parents=True, exist_ok=True)
            (copy / path.relative_to(original)).write_bytes(path.read_bytes())
    return copy


def _problem() -> ur.Problem:
    return ur.gallery.problem("exponential")


def refused(folder: Path, call: Callable[[], Any]) -> str:
    """The one line by which `call` refuses; nothing beside `folder` may change, and nothing may be imported or run."""
    before = _tree(folder.parent)
    with pytest.raises(InputError) as caught:
        call()
    line = str(caught.value)
    assert "\n" not in line
    assert len(line) < 800
    after = _tree(folder.parent)
    lock = f"{folder.name}/lock"
    assert {k: v for k, v in after.items() if k != lock} == {k: v for k, v in before.items() if k != lock}
    assert _CANARY not in sys.modules
    return line


def _tree(root: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(root)): p.read_bytes() if p.is_file() and p.stat().st_size < 1 << 22 else b""
        for p in root.rglob("*")
    }


# ---------------------------------------------------------------------- checkpoints


def _state(folder: Path) -> Path:
    return folder / "checkpoints" / "00000004" / checkpoint.STATE


def _manifest(folder: Path) -> Path:
    return folder / "checkpoints" / "00000004" / checkpoint.MANIFEST


def _put(folder: Path, data: bytes) -> None:
    """Other tensors, to which the manifest is made to fit."""
    _state(folder).write_bytes(data)
    _edit_manifest(folder, size=len(data), sha256=hashlib.sha256(data).hexdigest())


def _edit_manifest(folder: Path, **fields: Any) -> None:
    found = json.loads(_manifest(folder).read_text())
    _manifest(folder).write_text(json.dumps({**found, **fields}))


def _tensors(header: Any, body: bytes = b"\0" * 8) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body


def _one(dtype: str = "F64", shape: Any = (), offsets: Any = (0, 8)) -> dict[str, Any]:
    return {"dtype": dtype, "shape": list(shape), "data_offsets": list(offsets)}


def _node(folder: Path, edit: Callable[[dict[str, Any]], Any]) -> None:
    """Change the skeleton: `edit` gets {name: node} of the snapshot."""
    found = json.loads(_manifest(folder).read_text())
    nodes = dict(found["state"]["dict"])
    edit(nodes)
    _edit_manifest(folder, state={"dict": [list(pair) for pair in nodes.items()]})


def _deep(levels: int) -> Any:
    node: Any = 1
    for _ in range(levels):
        node = {"list": [node]}
    return node


def _class(name: str, **fields: Any) -> dict[str, Any]:
    return {"class": name, "fields": fields}


def _link_checkpoint(folder: Path) -> None:
    there = folder / "checkpoints" / "00000004"
    away = folder.parent / "away"
    there.rename(away)
    there.symlink_to(away)


def _link_checkpoints(folder: Path) -> None:
    away = folder.parent / "away"
    (folder / "checkpoints").rename(away)
    (folder / "checkpoints").symlink_to(away)


def _link_state(folder: Path) -> None:
    away = folder.parent / "state"
    _state(folder).rename(away)
    _state(folder).symlink_to(away)


_BOMB = "1" * 5000
_PICKLE = pickle.dumps({"a": 1})
CHECKPOINTS: dict[str, Callable[[Path], Any]] = {
    "truncated tensors": lambda f: _state(f).write_bytes(_state(f).read_bytes()[:-1]),
    "truncated, and the manifest says so": lambda f: _put(f, _state(f).read_bytes()[:-1]),
    "no tensors at all": lambda f: _state(f).unlink(),
    "an empty file": lambda f: _put(f, b""),
    "one flipped bit": lambda f: _state(f).write_bytes(_state(f).read_bytes()[:-1] + b"\x7f"),
    "a header of an exabyte": lambda f: _put(f, struct.pack("<Q", 1 << 60) + b"{}"),
    "a header as long as the file says it is not": lambda f: _put(f, struct.pack("<Q", 64) + b"{}"),
    "an absurd shape": lambda f: _put(f, _tensors({"0": _one(shape=(1 << 40, 1 << 40))})),
    "a large shape over few bytes": lambda f: _put(f, _tensors({"0": _one(shape=(1 << 33,))})),
    "a negative shape": lambda f: _put(f, _tensors({"0": _one(shape=(-1,))})),
    "offsets outside": lambda f: _put(f, _tensors({"0": _one(offsets=(8, 16))})),
    "offsets backwards": lambda f: _put(f, _tensors({"0": _one(offsets=(8, 0))})),
    "overlapping tensors": lambda f: _put(f, _tensors({"0": _one(), "1": _one()})),
    "an unknown type": lambda f: _put(f, _tensors({"0": _one("OBJECT")})),
    "a type that NumPy has not": lambda f: _put(f, _tensors({"0": _one("BF16", (4,))})),
    "a name twice": lambda f: _put(f, _tensors(f'{{"0": {json.dumps(_one())}, "0": {json.dumps(_one())}}}'.encode())),
    "a header nested deeply": lambda f: _put(f, _tensors(b"[" * 100_000)),
    "a header that is a list": lambda f: _put(f, _tensors([])),
    "a pickle": lambda f: _put(f, _PICKLE),
    "a path as a tensor's name": lambda f: _put(f, _tensors({"../../escape": _one()})),
    "tensors of another shape": lambda f: _put(f, _tensors({str(n): _one("F64", (1, 1), (8 * n, 8 * n + 8)) for n in range(9)}, bytes(72))),
    "a manifest that is no JSON": lambda f: _manifest(f).write_text("{"),
    "a manifest that is a list": lambda f: _manifest(f).write_text("[]"),
    "a manifest nested deeply": lambda f: _manifest(f).write_text("[" * 200_000),
    "a manifest with a name twice": lambda f: _manifest(f).write_text('{"step": 1, "step": 2}'),
    "a manifest of binary": lambda f: _manifest(f).write_bytes(b"\xff\xfe\0"),
    "a manifest of an endless number": lambda f: _manifest(f).write_text(f'{{"step": {_BOMB}}}'),
    "a manifest with a path": lambda f: _edit_manifest(f, file="../../escape"),
    "a step that is NaN": lambda f: _edit_manifest(f, step=float("nan")),
    "a negative step": lambda f: _edit_manifest(f, step=-4),
    "a step in words": lambda f: _edit_manifest(f, step="4"),
    "a step of another folder": lambda f: _edit_manifest(f, step=5),
    "a format to come": lambda f: _edit_manifest(f, format=2),
    "a size that is negative": lambda f: _edit_manifest(f, size=-1),
    "a digest that is a path": lambda f: _edit_manifest(f, sha256="../../etc/passwd"),
    "a state that is text": lambda f: _edit_manifest(f, state="state"),
    "a state that is a number": lambda f: _edit_manifest(f, state=1e308),
    "a class of the standard library": lambda f: _node(f, lambda n: n.update(optimizer=_class("os.system", command="touch escape"))),
    "a class of another module": lambda f: _node(f, lambda n: n.update(optimizer=_class(f"unrender.{_CANARY}.State"))),
    "a function of this package": lambda f: _node(f, lambda n: n.update(optimizer=_class("unrender.io.files.write", path="escape"))),
    "a class that is no state": lambda f: _node(f, lambda n: n.update(optimizer=_class("unrender.runs.folder.writer.RunWriter"))),
    "another state": lambda f: _node(f, lambda n: n.update(optimizer=_class("unrender.estimators.loss_values.LossState"))),
    "a state with other fields": lambda f: _node(f, lambda n: n["optimizer"]["fields"].update(more=1)),
    "a state with a field of another type": lambda f: _node(f, lambda n: n["optimizer"]["fields"].update(step="4")),
    "a state nested deeply": lambda f: _node(f, lambda n: n.update(optimizer=_deep(200))),
    "a tensor that is not there": lambda f: _node(f, lambda n: n["optimizer"]["fields"].update(step={"array": 99, "kind": "numpy"})),
    "a kind of array that is none": lambda f: _node(f, lambda n: n["optimizer"]["fields"].update(step={"array": 0, "kind": "system"})),
    "a negative number of steps inside": lambda f: _node(f, lambda n: n.update(step=-1)),
    "a clock that is NaN": lambda f: _node(f, lambda n: n.update(clock={"float": "nan"})),
    "warnings that are none": lambda f: _node(f, lambda n: n.update(warnings={"list": [1]})),
    "a part missing": lambda f: _node(f, lambda n: n.pop("noise")),
    "a checkpoint that is a link": _link_checkpoint,
    "checkpoints that are a link": _link_checkpoints,
    "tensors that are a link": _link_state,
    "a history that is shorter": lambda f: (f / "history.jsonl").write_text('{"step": 0}\n'),
    "a history of something else": lambda f: (f / "history.jsonl").write_text("<html>\n" * 9),
}  # fmt: skip


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_a_hostile_checkpoint_is_refused(folder: Path, name: str) -> None:
    CHECKPOINTS[name](folder)
    refused(folder, lambda: ur.resume(folder, steps=8))
    refused(folder, lambda: ur.resume(folder, steps=8, force=True))


# ---------------------------------------------------------------------- the other files of a run folder


def _edit_record(folder: Path, **fields: Any) -> None:
    found = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**found, **fields}))


def _method(folder: Path, old: str, new: str) -> None:
    text = (folder / "method.toml").read_text()
    assert old in text
    (folder / "method.toml").write_text(text.replace(old, new))


RECORDS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no run.json": (lambda f: (f / "run.json").unlink(), "run.json is missing"),
    "run.json as a folder": (lambda f: [(f / "run.json").unlink(), (f / "run.json").mkdir()], "run.json is missing"),
    "a list": (lambda f: (f / "run.json").write_text("[]"), "expected an object"),
    "nested deeply": (lambda f: (f / "run.json").write_text('{"a":' * 100_000), "nested too deeply"),
    "an unknown status": (lambda f: _edit_record(f, status="pwned"), "status"),
    "steps that are NaN": (lambda f: _edit_record(f, steps=float("nan")), "steps"),
    "negative seconds": (lambda f: _edit_record(f, seconds=-1), "seconds"),
    "a problem in words": (lambda f: _edit_record(f, problem="../../etc"), "problem"),
    "no method.toml": (lambda f: (f / "method.toml").unlink(), "method.toml: no such file"),
    "no TOML": (lambda f: (f / "method.toml").write_text("a = ["), "not valid TOML"),
    "TOML nested deeply": (lambda f: (f / "method.toml").write_text("a = " + "[" * 50_000), "method.toml"),
    "steps in words": (lambda f: _method(f, "steps = 4", 'steps = "4"'), "steps"),
    "negative steps": (lambda f: _method(f, "steps = 4", "steps = -4"), "steps"),
    "steps without end": (lambda f: _method(f, "steps = 4", "steps = inf"), "steps"),
    "an estimator of another library": (lambda f: _method(f, '"PathGradient"', '"os.system"'), "unknown type"),
    "an optimizer with an option too many": (lambda f: _method(f, "beta_1", "command"), "has no option command"),
    "an option of the wrong type": (lambda f: _method(f, "beta_1 = 0.9", 'beta_1 = "x"'), "beta_1"),
    "two parts that are one another's": (lambda f: _method(f, '"PathGradient"', '"Adam"'), "Adam has no option"),
    "an estimator that is text": (lambda f: _method(f, "seed = 0", 'more = "x"\nseed = 0'), "more"),
    "no problem.toml": (lambda f: (f / "problem.toml").unlink(), "problem.toml: no such file"),
    "a problem of the wrong type": (lambda f: (f / "problem.toml").write_text("gallery = 3"), "expected gallery"),
    "a gallery problem that is none": (lambda f: (f / "problem.toml").write_text('gallery = "../x"'), "no problem ../x"),
    "an option that is none": (
        lambda f: (f / "problem.toml").write_text('gallery = "quad"\n[options]\nx = 1'), "no option x",
    ),
    "an origin of a name without end": (
        lambda f: [
            _edit_record(f, problem={"origin": {"file": "/" + 5000 * "x"}}),
            (f / "problem.toml").write_text('scene = "a.xml"'),
        ],
        "File name too long",
    ),
    "a seed that no file holds": (lambda f: _method(f, "seed = 0", "seed = 99999999999999999999"), "seed"),
    "a lock that is a link": (lambda f: (f / "lock").symlink_to(f.parent / "escape"), "cannot be locked"),
}  # fmt: skip


@pytest.mark.parametrize("name", RECORDS)
def test_a_hostile_run_folder_is_refused(folder: Path, name: str) -> None:
    spoil, expected = RECORDS[name]
    spoil(folder)
    assert expected in refused(folder, lambda: ur.resume(folder, steps=8))


# ---------------------------------------------------------------------- archives and arrays


def _npy(header: str, body: bytes = b"") -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


def _npz(path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> None:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def _lying(path: Path) -> None:
    """An archive whose directory says that a member of a megabyte has ten bytes."""
    _npz(path, {"a.npy": _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (262144,), }", b"\0" * (1 << 20))})
    data = bytearray(path.read_bytes())
    at = data.rindex(b"PK\x01\x02")
    data[at + 24 : at + 28] = struct.pack("<I", 10)
    path.write_bytes(bytes(data))


_HUGE = "{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776, 1099511627776), }"
ARCHIVES: dict[str, Callable[[Path], Any]] = {
    "no archive": lambda p: p.write_bytes(b"no"),
    "a pickle": lambda p: p.write_bytes(_PICKLE),
    "an array of objects": lambda p: np.savez(p, a=np.array([{}], object)),
    "an absurd shape": lambda p: _npz(p, {"a.npy": _npy(_HUGE, b"\0" * 8)}),
    "a negative shape": lambda p: _npz(p, {"a.npy": _npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }")}),
    "code for a shape": lambda p: _npz(p, {"a.npy": _npy(f"{{'descr': '<f8', 'shape': __import__('{_CANARY}'), }}")}),
    "a header that never ends": lambda p: _npz(p, {"a.npy": b"\x93NUMPY\x02\x00" + struct.pack("<I", 1 << 31) + b" " * 99}),
    "too short": lambda p: _npz(p, {"a.npy": _npy("{'descr': '<f8', 'fortran_order': False, 'shape': (9,), }", b"\0")}),
    "a zip bomb": lambda p: _npz(p, {"a.npy": _npy("{'descr': '|u1', 'fortran_order': False, 'shape': (19999999,), }", bytes(19_999_999))}),
    "a directory that lies": _lying,
    "an encrypted member": lambda p: p.write_bytes(_flagged(p)),
    "no array": lambda p: _npz(p, {"../../escape": b"text"}),
}  # fmt: skip


def _flagged(path: Path) -> bytes:
    _npz(path, {"a.npy": _npy("{'descr': '<f8', 'fortran_order': False, 'shape': (), }", b"\0" * 8)})
    data = bytearray(path.read_bytes())
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        data[data.index(mark) + offset] |= 1
    return bytes(data)


@pytest.mark.parametrize("name", ARCHIVES)
def test_a_hostile_archive_is_refused(tmp_path: Path, name: str) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    ARCHIVES[name](inside / "a.npz")
    refused(inside, lambda: bounded_files.read_arrays(inside / "a.npz", most_bytes=1 << 24))


def test_a_member_twice_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", b"x")
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("a.npy", b"x")
    with pytest.raises(InputError, match="given twice"):
        bounded_files.read_arrays(tmp_path / "a.npz")


HEADERS = [_HUGE, "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }", "{", "[" * 9999, _HUGE[:60] + "1" * 3000]


@pytest.mark.parametrize("header", HEADERS)
def test_a_hostile_npy_is_refused(tmp_path: Path, header: str) -> None:
    (tmp_path / "a.npy").write_bytes(_npy(header, b"\0" * 8))
    with pytest.raises(InputError, match=r"a\.npy: "):
        bounded_files.read_array(tmp_path / "a.npy")


def test_arrays_come_back_as_they_were(tmp_path: Path) -> None:
    given = {
        "a": np.arange(6.0).reshape(2, 3),
        "view0/b": np.asfortranarray(np.ones((2, 3), np.float32)),
        "c": np.zeros((0, 2), int),
    }
    np.savez_compressed(tmp_path / "a.npz", allow_pickle=False, **given)
    found = bounded_files.read_arrays(tmp_path / "a.npz")
    assert list(found) == list(given)
    for name, array in given.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


# ---------------------------------------------------------------------- pictures


def _exr(width: int, height: int, channels: str = "RGB", version: int = 2) -> bytes:
    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value

    listed = b"".join(c.encode() + b"\0" + struct.pack("<iiii", 2, 0, 1, 1) for c in channels) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    return (
        b"\x76\x2f\x31\x01" + struct.pack("<I", version)
        + attribute("channels", "chlist", listed) + attribute("compression", "compression", b"\3")
        + attribute("dataWindow", "box2i", window) + attribute("displayWindow", "box2i", window)
        + attribute("lineOrder", "lineOrder", b"\0") + attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
        + attribute("screenWindowCenter", "v2f", bytes(8)) + attribute("screenWindowWidth", "float", struct.pack("<f", 1))
        + b"\0" + bytes(64)
    )  # fmt: skip


def _png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(99))) + chunk(b"IEND", b"")
    )


PICTURES = {
    "huge.exr": _exr(100_000, 100_000),
    "wide.exr": _exr(2_000_000_000, 1),
    "inverted.exr": _exr(-5, 4),
    "many.exr": _exr(20_000, 20_000, "ABCDEFGHIJ"),
    "parts.exr": _exr(100_000, 100_000, version=2 | 0x1000),
    "cut.exr": _exr(4, 4)[:60],
    "attribute.exr": b"\x76\x2f\x31\x01" + struct.pack("<I", 2) + b"a\0b\0" + struct.pack("<i", 1 << 30),
    "negative.exr": b"\x76\x2f\x31\x01" + struct.pack("<I", 2) + b"a\0b\0" + struct.pack("<i", -9) + bytes(32),
    "endless.exr": b"\x76\x2f\x31\x01" + struct.pack("<I", 2) + b"a" * 4096,
    "huge.png": _png(100_000, 100_000),
    "huge.hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 100000 +X 100000\n",
    "huge.pfm": b"PF\n100000 100000\n-1.0\n" + bytes(64),
    "huge.bmp": b"BM" + struct.pack("<IIIIiiHHIIiiII", 64, 0, 54, 40, 100_000, 100_000, 1, 24, 0, 0, 0, 0, 0, 0),
    "huge.tga": bytes([0, 0, 2]) + bytes(9) + struct.pack("<HH", 65_535, 65_535) + bytes([24, 0]) + bytes(16),
    "huge.ppm": b"P6\n100000 100000\n255\n",
}


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_of_enormous_size_is_refused_by_its_header(tmp_path: Path, name: str) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    (inside / name).write_bytes(PICTURES[name])
    said = refused(inside, lambda: images.read(inside / name))
    assert "declares" in said or "header is malformed" in said


# ---------------------------------------------------------------------- scenes and problem files

SCENES = {
    "an absolute include": '<scene version="3.0.0"><include filename="/etc/passwd"/></scene>',
    "an include above": '<scene version="3.0.0"><include filename="../secret.xml"/></scene>',
    "an include by a link": '<scene version="3.0.0"><include filename="link.xml"/></scene>',
    "an include by a default": (
        '<scene version="3.0.0"><default name="d" value="/etc"/><include filename="$d/passwd"/></scene>'
    ),
    "an include of an include": '<scene version="3.0.0"><include filename="inner.xml"/></scene>',
    "an include of itself": '<scene version="3.0.0"><include filename="scene.xml"/></scene>',
    "an include that is not there": '<scene version="3.0.0"><include filename="none.xml"/></scene>',
    "a search path": '<scene version="3.0.0"><path value="/etc"/><include filename="passwd"/></scene>',
    "an external entity": '<!DOCTYPE s [<!ENTITY x SYSTEM "file:///etc/passwd">]><scene version="3.0.0">&x;</scene>',
    "a billion laughs": '<!DOCTYPE s [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]><scene version="3.0.0">&b;</scene>',
    "a scene nested deeply": "<scene>" * 100_000,
    "no XML": "#!/bin/sh\ntouch escape\n",
}


@pytest.mark.parametrize("name", SCENES)
def test_a_hostile_scene_is_refused(tmp_path: Path, name: str) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "secret.xml").write_text("<scene/>")
    (inside / "link.xml").symlink_to(tmp_path / "secret.xml")
    (inside / "inner.xml").write_text('<scene version="3.0.0"><include filename="../secret.xml"/></scene>')
    (inside / "scene.xml").write_text(SCENES[name])
    said = refused(inside, lambda: ur.Problem(inside / "scene.xml", [ur.Parameter("a")], [ur.View("a.exr")]))
    assert said.startswith("scene: ")
    assert "Mitsuba" not in said


def test_includes_inside_the_folder_are_followed(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><default name="p" value="parts"/><include filename="$p/a.xml"/></scene>'
    )
    (tmp_path / "parts" / "a.xml").write_text(
        '<scene version="3.0.0"><string name="filename" value="wall.png"/></scene>'
    )
    (tmp_path / "wall.png").write_bytes(b"")
    assert [path.name for path in scene_files.of(tmp_path / "scene.xml")] == ["scene.xml", "a.xml", "wall.png"]


PROBLEMS = {
    "a scene that is a number": "scene = 3",
    "a scene that is a table": '[scene]\npath = "x"',
    "no text": b"\xff\xfe\x00scene",
    "nested deeply": "a = " + "[" * 50_000,
    "an endless number": f"scene = {_BOMB}",
    "a date for a name": 'name = 1979-05-27\nscene = "x.xml"',
    "views in words": 'scene = "x.xml"\nviews = "all"\n[[parameters]]\nkey = "a"',
    "a loss of another library": 'scene = "x.xml"\nloss = "os.system"\n[[parameters]]\nkey="a"\n[[views]]\nreference="a.exr"',
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_hostile_problem_file_is_refused(tmp_path: Path, name: str) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    text = PROBLEMS[name]
    (inside / "p.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    assert "p.toml" in refused(inside, lambda: ur.Problem.from_file(inside / "p.toml"))


def test_json_gives_each_name_once() -> None:
    with pytest.raises(InputError, match="'a' is given twice"):
        bounded_files.parse_json('{"a": 1, "a": 2}', "x")


def test_a_pipe_is_no_run_folder_s_file(folder: Path) -> None:
    """A named pipe would block whoever opens it."""
    _state(folder).unlink()
    os.mkfifo(_state(folder))
    refused_quickly = refused(folder, lambda: ur.resume(folder, steps=8))
    assert "state.safetensors" in refused_quickly


def test_the_tests_begin_with_a_folder_that_is_taken_up(folder: Path) -> None:
    result = ur.resume(folder, steps=8)
    assert result.steps == 8
    assert result.resumed == [4]
    with io.BytesIO((folder / "parameters.npz").read_bytes()) as data:
        assert np.load(data).files
