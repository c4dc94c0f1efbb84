"""Sound files are read, whatever their format allows; those that would take long or much memory are refused by what they declare."""

from __future__ import annotations

import io
import os
import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from unrender.core.errors import InputError
from unrender.io import bounded_files, files, image_size, mesh_files, scene_files, toml_lines, volumes

# ---------------------------------------------------------------------- pictures


def _pillow(mode: str, form: str, **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.new(mode, (5, 3)).save(buffer, form, **options)
    return buffer.getvalue()


def _noise(form: str, **options: Any) -> bytes:
    pixels = np.random.default_rng(0).integers(0, 2, (30, 50, 3), np.uint8) * 255
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, form, **options)
    return buffer.getvalue()


SOUND = {
    "grey PNG": (_pillow("L", "PNG"), 15),
    "black and white PNG": (_pillow("1", "PNG"), 15),
    "16-bit PNG": (_pillow("I;16", "PNG"), 15),
    "PNG": (_pillow("RGB", "PNG"), 45),
    "PNG with alpha": (_pillow("RGBA", "PNG"), 60),
    "PNG with grey and alpha": (_pillow("LA", "PNG"), 30),
    "PNG with a palette": (_pillow("P", "PNG"), 60),
    "JPEG": (_pillow("RGB", "JPEG"), 45),
    "grey JPEG": (_pillow("L", "JPEG"), 15),
    "progressive JPEG": (_noise("JPEG", progressive=True), 4500),
    "BMP": (_pillow("RGB", "BMP"), 45),
    "TGA": (_pillow("RGB", "TGA"), 45),
    "TGA in runs": (_noise("TGA", compression="tga_rle"), 4500),
    "PPM": (_pillow("RGB", "PPM"), 45),
    "HDR": (b"#?RADIANCE\r\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=1\n\n-Y 3 +X 5\n" + bytes(60), 45),
    "PFM": (b"PF\n5 3\n-1.0\n" + bytes(180), 45),
    "grey PFM": (b"Pf\n5 3\n-1.0\n" + bytes(60), 15),
}


@pytest.mark.parametrize("name", SOUND)
@pytest.mark.parametrize("ending", [".png", ".hdr"])
def test_sound_pictures_are_measured(tmp_path: Path, name: str, ending: str):
    """By what they are, whatever they are called."""
    data, values = SOUND[name]
    (tmp_path / f"a{ending}").write_bytes(data)
    assert image_size.check(tmp_path / f"a{ending}") == values


def test_a_large_picture_of_few_bytes_is_refused(tmp_path: Path):
    path = tmp_path / "a.pfm"
    with path.open("wb") as file:
        file.write(b"PF\n4096 4096\n-1.0\n")
        file.truncate(200_000_000)
    assert image_size.check(path) == 3 << 24
    os.truncate(path, 90_000)
    with pytest.raises(InputError, match="declares 4096x4096 pixels of 3 channels in 90000 bytes"):
        image_size.check(path)


def test_a_jpeg_of_many_scans_is_refused(tmp_path: Path):
    data = _noise("JPEG", progressive=True)
    (tmp_path / "a.jpg").write_bytes(data[:-2] + b"\xff\xda\0\2" * 200 + data[-2:])
    with pytest.raises(InputError, match="more than 100 scans"):
        image_size.check(tmp_path / "a.jpg")
    (tmp_path / "a.jpg").write_bytes(data + b"\xff\xda\0\2" * 200)  # a video after the picture
    assert image_size.check(tmp_path / "a.jpg") > 0


def test_what_follows_a_jpeg_takes_no_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(image_size, "MOST_VALUES", 1 << 20)
    (tmp_path / "a.jpg").write_bytes(_noise("JPEG"))
    os.truncate(tmp_path / "a.jpg", 1 << 26)
    tracemalloc.start()
    try:
        assert image_size.check(tmp_path / "a.jpg") > 0
        assert tracemalloc.get_traced_memory()[1] < 1 << 24
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_that_ends_too_soon_is_refused(tmp_path: Path, progressive: bool):
    """Decoders fill the rest with grey. The end of its thumbnail is not that of the picture."""
    exif = Image.Exif()
    exif[0x927C] = _noise("JPEG")[:60_000]
    file = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)).save(
        file, "JPEG", progressive=progressive, exif=exif
    )
    (tmp_path / "a.jpg").write_bytes(file.getvalue())
    assert image_size.check(tmp_path / "a.jpg") == 3 * 64 * 64
    for missing in (200, 2):  # of a picture that lacks its end marker alone, nothing is missing
        (tmp_path / "a.jpg").write_bytes(file.getvalue()[:-missing])
        with pytest.raises(InputError, match="it has no end marker, so a part may be missing; copy the file again"):
            image_size.check(tmp_path / "a.jpg")


def _hdr(rows: bytes, width: int = 8, height: int = 2) -> bytes:
    return f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode() + rows


_ROW = b"\2\2\0\x08" + 4 * b"\x88\x01"  # one run of eight for each channel
SCANLINES: dict[str, tuple[bytes, bool]] = {
    "runs": (2 * _ROW, True),
    "runs and single values": (b"\2\2\0\x08" + 4 * (b"\x85\x01\x03abc") + _ROW, True),
    "no runs": (bytes(64), True),
    "a run too long": (_ROW + b"\2\2\0\x08" + 4 * b"\x89\x01", False),
    "single values too many": (b"\2\2\0\x08" + 4 * b"\x09abcdefghi" + _ROW, False),
    "a run of none": (b"\2\2\0\x08" + 4 * b"\x80\x01\x88\x01" + _ROW, False),
    "a row without runs after one with": (_ROW + bytes(32), False),
    "a row of another width": (_ROW + _ROW.replace(b"\2\2\0\x08", b"\2\2\0\x09"), False),
    "a row too few": (_ROW, False),
}


@pytest.mark.parametrize("name", SCANLINES)
def test_runs_of_an_hdr_file_must_fill_its_rows(name: str, tmp_path: Path):
    """Mitsuba writes on behind the picture: the process died."""
    rows, sound = SCANLINES[name]
    (tmp_path / "a.hdr").write_bytes(_hdr(rows))
    if sound:
        assert image_size.check(tmp_path / "a.hdr") == 48
        return
    with pytest.raises(InputError, match="header is malformed"):
        image_size.check(tmp_path / "a.hdr")


# ---------------------------------------------------------------------- meshes and other files of a scene


def _ply(
    body: bytes,
    faces: str = "property list uchar int vertex_indices",
    count: int = 1,
    form: str = "binary_little_endian",
) -> bytes:
    points = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat {form} 1.0\ncomment by hand\nelement vertex 3\n{points}element face {count}\n{faces}\nend_header\n"
    return header.encode() + body


_POINTS = np.eye(3, dtype="<f4").tobytes()
_TEXT = b"1 0 0\n0 1 0\n0 0 1\n"
MESHES: dict[str, tuple[bytes, str]] = {
    "sound": (_ply(_POINTS + struct.pack("<B3i", 3, 0, 1, 2)), ""),
    "sound, big-endian": (_ply(np.eye(3, dtype=">f4").tobytes() + struct.pack(">B3i", 3, 0, 1, 2), form="binary_big_endian"), ""),
    "sound, in text": (_ply(_TEXT + b"3 0 1 2\n", form="ascii"), ""),
    "sound, other types": (_ply(_POINTS + struct.pack("<I3B", 3, 2, 1, 0), "property list uint uchar vertex_index"), ""),
    "sound, with a colour a face": (
        _ply(_POINTS + struct.pack("<B3if", 3, 0, 1, 2, 0.5), "property list uchar int vertex_indices\nproperty float red"), "",
    ),
    "sound, no faces": (_ply(_POINTS, count=0), ""),
    "a text that is cut short": (_ply(_TEXT + b"3 0 1\n", form="ascii"), "cut short"),
    "an index out of range in text": (_ply(_TEXT + b"3 0 1 99999999999999999999\n", form="ascii"), "expected less than 3"),
    "a negative index in text": (_ply(_TEXT + b"3 0 1 -1\n", form="ascii"), "whole numbers"),
    "indices that are no integers": (_ply(_POINTS + struct.pack("<B3f", 3, 0, 1, 2), "property list uchar float vertex_indices"), "whole"),
    "two lists": (_ply(b"", "property list uchar int vertex_indices\nproperty list uchar int vertex_index"), "given twice"),
    "no list": (_ply(b"", "property int vertex_indices"), "expected one list"),
    "trailing bytes": (_ply(_POINTS + struct.pack("<B3i", 3, 0, 1, 2) + b"x"), "declares 49 bytes of numbers, there are 50"),
}  # fmt: skip


@pytest.mark.parametrize("name", MESHES)
def test_meshes_are_checked(tmp_path: Path, name: str):
    data, message = MESHES[name]
    (tmp_path / "a.ply").write_bytes(data)
    if not message:
        mesh_files.check_ply(tmp_path / "a.ply")
        return
    with pytest.raises(InputError, match=message):
        mesh_files.check_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_meshes_are_checked_to_their_last_face(tmp_path: Path, form: str):
    """Blocks end within rows."""
    count = 150_000
    faces = np.tile([0, 1, 2], (count, 1))
    for last, message in ((2, ""), (3, f"face {count - 1} has the vertices 0, 1, 3")):
        faces[-1, 2] = last
        if form == "ascii":
            body = _TEXT + b"".join(b"3 %d %d %d\n" % tuple(face) for face in faces.tolist())
        else:
            rows = np.zeros(count, [("n", "u1"), ("i", "<i4", 3)])
            rows["n"], rows["i"] = 3, faces
            body = _POINTS + rows.tobytes()
        (tmp_path / "a.ply").write_bytes(_ply(body, count=count, form=form))
        if message:
            with pytest.raises(InputError, match=message):
                mesh_files.check_ply(tmp_path / "a.ply")
        else:
            mesh_files.check_ply(tmp_path / "a.ply")


def test_large_obj_files_of_sound_meshes_pass(tmp_path: Path):
    lines = [f"v {n} 0 0\nvt 0 {n}" for n in range(9000)]
    lines += [f"f {n}/{n}/1 {n + 1}/{n + 1}/1 {n + 2}/{n + 2}/1" for n in range(1, 8990)]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    assert (tmp_path / "a.obj").stat().st_size > 1 << 18
    mesh_files.check_obj(tmp_path / "a.obj")


def test_spectra_and_tensors_of_sound_files_pass(tmp_path: Path):
    (tmp_path / "a.spd").write_text("# a comment\n400 0.5\n\n500.5   1e-3 # another\r\n")
    scene_files.check_spectrum(tmp_path / "a.spd")
    (tmp_path / "a.spd").write_text("400 0.5 1\n")
    with pytest.raises(InputError, match=r"a\.spd:1: expected a wavelength and a value"):
        scene_files.check_spectrum(tmp_path / "a.spd")
    head = b"tensor_file\0\1\0" + struct.pack("<IH", 1, 1) + b"a" + struct.pack("<HBQQ", 1, 10, 46, 2)
    (tmp_path / "a.bsdf").write_bytes(head + bytes(50 - len(head)) + bytes(4))
    scene_files.check_tensors(tmp_path / "a.bsdf")


def test_a_sound_grid_is_measured(tmp_path: Path):
    volumes.write_grid(tmp_path / "a.vol", np.zeros((2, 3, 4, 1)))
    assert volumes.check_vol(tmp_path / "a.vol") == 24


# ---------------------------------------------------------------------- names, archives, JSON


def test_kinds_of_files(tmp_path: Path):
    (tmp_path / "file").touch()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("nowhere")
    names = ("file", ".", "pipe", "link", "none", "file/x", "a\0b")
    assert [bounded_files.kind(tmp_path / name) for name in names] == ["file", "folder", "other", "", "", "", ""]
    with pytest.raises(InputError, match="name too long"):
        bounded_files.kind(tmp_path / ("A" * 5000))


def test_large_arrays_are_stored_as_they_are(tmp_path: Path):
    """A constant texture of many texels would unpack to a thousand times the bytes of its file, which readers refuse."""
    large = np.full(files.COMPRESSED_BYTES // 4, 0.5, np.float32)
    files.write_arrays(tmp_path / "a.npz", {"x": large})
    assert np.array_equal(bounded_files.read_arrays(tmp_path / "a.npz")["x"], large)
    np.savez_compressed(tmp_path / "b.npz", x=np.concatenate([large, large]))
    with pytest.raises(InputError, match="save them without compression"):
        bounded_files.read_arrays(tmp_path / "b.npz")


def test_arrays_that_were_read_may_be_written_to(tmp_path: Path):
    np.savez(tmp_path / "a.npz", x=np.arange(3.0))
    found = bounded_files.read_arrays(tmp_path / "a.npz")["x"]
    found += 1
    assert found.tolist() == [1.0, 2.0, 3.0]


def _quickly(call: Callable[[], Any]) -> str:
    began = time.process_time()
    with pytest.raises(InputError) as caught:
        call()
    assert time.process_time() - began < 1
    return str(caught.value)


def test_a_hundred_thousand_names_of_which_the_last_is_the_first():
    names = [f'"{n:x}": 0' for n in range(150_000)]
    assert "'1' is given twice" in _quickly(
        lambda: bounded_files.parse_json("{" + ", ".join([*names, '"1": 0']) + "}", "x")
    )
    assert "more than 200000 values" in _quickly(lambda: bounded_files.parse_json("[" + "1," * 400_000 + "1]", "x"))


# ---------------------------------------------------------------------- TOML

_LINES = '''a = """
[[b]]
c = 1 # " in a string
d""""
e = [ # one
  "]", ']', """]""", {x = [1, 2], y = "="},
]
'k=y'."l\\"=" = { m = 1 }
[[t]]
n = ["a", 'b\\'] # ]
[[t]]
o = \'\'\'
[x]
\'\'\'
p = 1
'''


@pytest.mark.parametrize(
    ("place", "line"),
    [
        (("a",), 1),
        (("e",), 5),
        (("k=y", 'l"='), 8),
        (("t", 0, "n"), 10),
        (("t", 1), 11),
        (("t", 1, "o"), 12),
        (("t", 1, "p"), 15),
    ],
)
def test_lines_are_found_behind_strings_and_brackets(place: toml_lines.Place, line: int):
    toml_lines.parse(_LINES, "x")
    assert toml_lines.find(_LINES, place) == line


LONG = {
    "a long list": "a = [\n" + "1,\n" * 60_000 + "]\n",
    "many dots": ("a." * 190 + "b = 1\n") * 170,
    "a long string": 'a = """\n' + "x\n" * 150_000 + '"""\n',
    "many tables": "[[a]]\nx = 1\n" * 20_000,
}


@pytest.mark.parametrize("name", LONG)
def test_no_line_is_searched_for_long(name: str):
    began = time.process_time()
    toml_lines.find(LONG[name], ("z",))
    assert time.process_time() - began < 3  # minutes, where every beginning of a statement is parsed


@pytest.mark.parametrize("text", ["#" * 400_000, "a" + ".a" * 300 + " = 1", "a = 0.5\n" * 40_000])
def test_long_toml_is_refused(text: str):
    assert _quickly(lambda: toml_lines.parse(text, "x.toml")).startswith("x.toml:")
