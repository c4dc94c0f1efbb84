"""Decoders behind an allow-list: which of Pillow's, OpenCV's and Mitsuba's a file can reach, and what they may be given."""

from __future__ import annotations

import ast
import contextlib
import io
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageOps, PngImagePlugin

import unrender
from unrender.app.capture import pictures
from unrender.core.errors import InputError
from unrender.io import image_size, images, tiff_header
from unrender.io.images import srgb_to_linear

cv2 = pytest.importorskip("cv2", reason="photographs need OpenCV")

PIXELS = np.random.default_rng(0).integers(0, 256, (20, 24, 3), np.uint8)
REACHED_BY_PILLOW = {"JPEG", "PNG", "WEBP", "BMP", "PPM", "TGA"}
REACHED_BY_OPENCV = {"TIFF", "PNG"}
ENDINGS = (".png", ".jpg", ".tif", ".webp", ".tga", ".bmp", ".ppm")


def _encoded(form: str) -> bytes:
    """The picture as one of Pillow's formats writes it; b"" where it cannot."""
    for mode in ("RGB", "L", "1", "P", "RGBA"):
        buffer = io.BytesIO()
        try:
            Image.fromarray(PIXELS).convert(mode).save(buffer, form)
        except Exception:
            continue
        if buffer.getvalue():
            return buffer.getvalue()
    return b""


def _by_hand() -> dict[str, bytes]:
    """First bytes of formats that Pillow opens and does not write."""
    return {
        "EPS": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n",
        "PSD": b"8BPS\0\1" + bytes(6) + struct.pack(">HIIHH", 3, 9, 9, 8, 3) + bytes(20),
        "FLI": bytes(4) + b"\x11\xaf" + bytes(140),
        "XPM": b'/* XPM */\nstatic char *a[] = {\n"1 1 1 1",\n"a c #000000",\n"a"};',
        "GD": bytes(1100),
        "FITS": b"SIMPLE  =                    T".ljust(80) + b"NAXIS   = 0".ljust(80) + b"END".ljust(2720),
        "WMF": b"\xd7\xcd\xc6\x9a" + bytes(60),
        "FTEX": b"FTEX" + bytes(60),
        "DCX": struct.pack("<I", 987654321) + bytes(60),
        "ICNS": b"icns" + struct.pack(">I", 8),
        "CUR": b"\0\0\2\0\1\0" + bytes(60),
        "BLP": b"BLP2" + bytes(200),
        "QOI": b"qoif" + struct.pack(">II", 1, 1) + b"\3\0\0\0\0\0\0\0\0\0\1",
    }


def test_pillow_decodes_kinds_of_the_allow_list_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each format that Pillow knows, under each name that a photograph may have."""
    Image.init()
    files = {form: data for form in Image.SAVE if (data := _encoded(form))} | _by_hand()
    assert len(files) > 25
    reached: set[str] = set()

    def watched(form: str, factory: Any) -> Any:
        def open_by(*arguments: Any) -> Any:
            reached.add(form)
            return factory(*arguments)

        return open_by

    for form, (factory, accept) in list(Image.OPEN.items()):
        monkeypatch.setitem(Image.OPEN, form, (watched(form, factory), accept))
    read = set()
    for form, data in files.items():
        for ending in ENDINGS:
            path = tmp_path / f"a{ending}"
            path.write_bytes(data)
            with contextlib.suppress(InputError):
                pictures.upright(path, None)
                pictures.read(path)
                pictures.read_mask(path)
                read.add(form)
    assert reached == REACHED_BY_PILLOW
    assert read - {"MPO", "JPEG2000"} <= REACHED_BY_PILLOW | {"TIFF", "DIB"}
    assert len(set(Image.OPEN) - reached) > 30, "so many decoders are out of reach"


@pytest.mark.mitsuba
def test_opencv_decodes_kinds_of_the_allow_list_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each format that OpenCV writes, in 8 and 16 bits, under each name."""
    given: set[str] = set()
    decode = cv2.imdecode

    def watched(data: np.ndarray, flags: int) -> Any:
        first = data[:8].tobytes()
        given.add("TIFF" if first[:4] in tiff_header.MAGICS else "PNG" if first[:4] == b"\x89PNG" else first.hex())
        return decode(data, flags)

    monkeypatch.setattr(cv2, "imdecode", watched)
    kinds = "png jpg tif webp bmp ppm pgm pbm pam pfm sr ras jp2 exr hdr avif gif pnm dib jxl"
    written = 0
    for kind in (f".{name}" for name in kinds.split()):
        for dtype in (np.uint8, np.uint16, np.float32):
            try:
                ok, data = cv2.imencode(kind, PIXELS.astype(dtype))
            except cv2.error:
                continue
            if not ok:
                continue
            written += 1
            for ending in ENDINGS:
                (tmp_path / f"a{ending}").write_bytes(data.tobytes())
                with contextlib.suppress(InputError):
                    pictures.read(tmp_path / f"a{ending}")
    assert written > 15
    assert given == REACHED_BY_OPENCV


def test_pictures_are_decoded_in_a_few_modules_alone() -> None:
    """Whoever decodes a file elsewhere goes round the allow-list and the guards."""
    allowed = {
        "io/images.py": {"Bitmap", "open"},
        "app/capture/pictures.py": {"open", "imdecode"},
        "gallery/parts.py": {"open"},
    }
    root = Path(unrender.__file__).parent
    found: dict[str, set[str]] = {}
    decoders = {"imread", "imdecode", "imreadmulti", "VideoCapture", "Bitmap", "open"}
    for path in root.rglob("*.py"):
        text = path.read_text()
        if not any(f".{name}(" in text for name in decoders - {"open"}) and "Image.open(" not in text:
            continue  # parsing each file takes seconds
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            name = node.func.attr
            if name not in decoders:
                continue
            owner = ast.unparse(node.func.value)
            decodes = name not in ("Bitmap", "open") or (owner, name) == ("Image", "open")
            from_file = name == "Bitmap" and node.args and ast.unparse(node.args[0]).startswith("str(")
            if decodes or from_file:
                found.setdefault(str(path.relative_to(root)), set()).add(name)
            if (owner, name) == ("Image", "open"):
                assert any(word.arg == "formats" for word in node.keywords), f"{path}:{node.lineno}"
    assert found == allowed


# ---------------------------------------------------------------------- what they may be given


def _tiff(
    width: int,
    height: int,
    data: bytes,
    compression: int = 8,
    channels: int = 3,
    bits: int = 8,
    more: tuple = (),
    order: str = "<",
) -> bytes:
    """One strip after the header."""
    tags = {256: width, 257: height, 258: bits, 259: compression, 262: 2 if channels > 1 else 1, 273: 8, 277: channels}
    tags |= {278: height, 279: len(data), **dict(more)}
    table = b"".join(struct.pack(order + "HHII", tag, 4, 1, value) for tag, value in sorted(tags.items()))
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8 + len(data))
    return head + data + struct.pack(order + "H", len(tags)) + table + bytes(4)


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


_PNG_HEAD = b"\x89PNG\r\n\x1a\n" + _png_chunk(b"IHDR", struct.pack(">IIBBBBB", 16, 16, 16, 2, 0, 0, 0))


def _webp(side: int) -> bytes:
    bits = (side - 1) | (side - 1) << 14
    body = b"VP8L" + struct.pack("<I", 10) + b"\x2f" + struct.pack("<I", bits) + bytes(5)
    return b"RIFF" + struct.pack("<I", 4 + len(body)) + b"WEBP" + body


BOMBS: dict[str, Callable[[], bytes]] = {
    "a TIFF of 15000 x 15000 in 700 kB": lambda: _tiff(15_000, 15_000, zlib.compress(bytes(100 << 20), 1)),
    "a TIFF of 9000 x 9000 in a few bytes": lambda: _tiff(9_000, 9_000, zlib.compress(bytes(1000))),
    "a big-endian TIFF": lambda: _tiff(9_000, 9_000, b"", order=">"),
    "a TIFF of many channels": lambda: _tiff(3_000, 3_000, b"", channels=60_000),
    "a TIFF of huge tiles": lambda: _tiff(16, 16, b"", more=((322, 1 << 30), (323, 1 << 30))),
    "a TIFF of zero sides": lambda: _tiff(0, 0, b""),
    "a TIFF by LERC": lambda: _tiff(16, 16, b"", compression=34887),
    "a TIFF by LZMA": lambda: _tiff(16, 16, b"", compression=34925),
    "a WebP of 16383 x 16383": lambda: _webp(16_383),
    "a WebP of 8000 x 8000": lambda: _webp(8_000),
    "a WebP animation": lambda: b"RIFF" + struct.pack("<I", 22) + b"WEBPVP8X" + struct.pack("<I", 10) + b"\2" + bytes(9),
    "a TGA without a footer": lambda: bytes([0, 0, 2]) + bytes(9) + struct.pack("<HH", 20_000, 20_000) + bytes([24, 0]),
    "a BMP": lambda: b"BM" + struct.pack("<IIIIiiHHIIiiII", 64, 0, 54, 40, 20_000, 20_000, 1, 24, 0, 0, 0, 0, 0, 0),
    "a PNG": lambda: b"\x89PNG\r\n\x1a\n" + _png_chunk(b"IHDR", struct.pack(">IIBBBBB", 20_000, 20_000, 8, 2, 0, 0, 0)),
    "a 16-bit PNG": lambda: b"\x89PNG\r\n\x1a\n" + _png_chunk(b"IHDR", struct.pack(">IIBBBBB", 20_000, 20_000, 16, 2, 0, 0, 0)),
    "a PNG of a chunk of 4 gigabytes": lambda: _PNG_HEAD + struct.pack(">I", 0xFFFFFFFF) + b"IDAT" + bytes(100),
    "a PNG of many chunks": lambda: _PNG_HEAD + _png_chunk(b"tEXt", b"") * (1 << 19),
    "a PGM": lambda: b"P5 # no pixels\n20000 20000\n255\n",
    "a plain PPM": lambda: b"P3\n20000 20000\n255\n",
    "an HDR": lambda: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 20000 +X 20000\n",
    "a PFM": lambda: b"PF\n20000 20000\n-1.0\n",
    "PostScript": lambda: b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n",
}  # fmt: skip


@pytest.mark.parametrize("ending", [".png", ".tga"])
@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_by_its_header(
    name: str, ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    monkeypatch.setattr(Image.Image, "load", lambda *_: pytest.fail("decoded"))
    path = tmp_path / f"a{ending}"
    path.write_bytes(BOMBS[name]())
    started = time.process_time()
    for read in (lambda: pictures.upright(path, None), lambda: pictures.read(path), lambda: pictures.read_mask(path)):
        with pytest.raises(InputError, match=r"a\.(png|tif|tga): ") as caught:
            read()
        assert str(caught.value).isprintable()
    assert time.process_time() - started < 2


_CHUNKS = b"iCCP cHRM gAMA sRGB tRNS pHYs tEXt zTXt iTXt eXIf acTL fcTL fdAT PLTE".split()


@pytest.mark.parametrize("content", [b"", b"\0", b"a", b"a\0", b"a\0\1"])
@pytest.mark.parametrize("kind", _CHUNKS)
def test_a_damaged_chunk_after_the_pixels_of_a_png_is_one_line(kind: bytes, content: bytes, tmp_path: Path) -> None:
    """Pillow raises `IndexError` at some."""
    path, whole = tmp_path / "a.png", _encoded("PNG")
    path.write_bytes(whole[:-12] + _png_chunk(kind, content) + whole[-12:])
    for read in (lambda: pictures.upright(path, None), lambda: pictures.read(path), lambda: pictures.read_mask(path)):
        with contextlib.suppress(InputError):
            read()


@pytest.mark.parametrize("form", ["TIFF", "WEBP", "BMP", "PPM", "TGA", "PNG"])
def test_sound_photographs_are_read(form: str, tmp_path: Path) -> None:
    """By what they are, whatever they are called."""
    for ending in (".png", ".tif", ".jpg", ".tga"):
        options: dict[str, Any] = {"lossless": True} if form == "WEBP" else {}
        if form == "TGA" and ending != ".tga":
            continue  # it has no first bytes of its own
        Image.fromarray(PIXELS).save(tmp_path / f"a{ending}", form, **options)
        assert pictures.upright(tmp_path / f"a{ending}", None) == (24, 20, 1)
        np.testing.assert_allclose(
            pictures.read(tmp_path / f"a{ending}").values, srgb_to_linear(PIXELS / 255.0), atol=1e-6
        )


@pytest.mark.parametrize("orientation", [1, 2, 3, 6, 7])
@pytest.mark.parametrize("compression", ["raw", "tiff_lzw", "tiff_adobe_deflate", "packbits"])
def test_tiffs_are_read_as_stored(compression: str, orientation: int, tmp_path: Path) -> None:
    """OpenCV turns them by their orientation, whatever it is told."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(PIXELS).save(tmp_path / "a.tif", compression=compression, exif=exif)
    told = pytest.raises(InputError, match=f"its EXIF orientation is {orientation}, and nothing tells")
    with told if orientation > 1 else contextlib.nullcontext():
        assert pictures.upright(tmp_path / "a.tif", None) == (24, 20, 1)
    assert image_size.read_photograph_header(tmp_path / "a.tif").orientation == orientation
    Image.fromarray(PIXELS).save(tmp_path / "a.png")
    np.testing.assert_array_equal(pictures.read(tmp_path / "a.tif").values, pictures.read(tmp_path / "a.png").values)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_orientation_of_exif_turns_pixels_upright(orientation: int) -> None:
    """As Pillow turns them: 5 and 7 are reflections at the two diagonals."""
    picture = Image.fromarray(PIXELS)
    picture.getexif()[0x0112] = orientation
    upright = np.asarray(ImageOps.exif_transpose(picture))
    np.testing.assert_array_equal(pictures._turn(PIXELS, orientation), upright)


@pytest.mark.parametrize("place", ["none", "before", "after", "text", "xmp"])
def test_pixels_of_a_png_are_not_decoded_again_unless_it_may_have_exif(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """EXIF may follow the pixels, be hexadecimal text, or be in XMP alone."""
    exif, texts, file = Image.Exif(), PngImagePlugin.PngInfo(), tmp_path / "a.png"
    exif[0x0112] = 6
    data = exif.tobytes()
    if place == "text":
        texts.add_text("Raw profile type exif", f"\nexif\n{len(data):8}\n{data.hex()}", zip=True)
    if place == "xmp":
        texts.add_itxt("XML:com.adobe.xmp", '<x:xmpmeta><rdf:Description tiff:Orientation="6"/></x:xmpmeta>')
    Image.fromarray(PIXELS).save(file, pnginfo=texts, exif=exif if place == "before" else b"")
    if place == "after":
        chunk = b"eXIf" + data.removeprefix(b"Exif\0\0")
        length, check = len(chunk) - 4, zlib.crc32(chunk)
        written = file.read_bytes()
        file.write_bytes(written[:-12] + struct.pack(">I", length) + chunk + struct.pack(">I", check) + written[-12:])
    if place == "none":
        monkeypatch.setattr(Image.Image, "load", lambda *_: pytest.fail("the pixels are decoded"))
    assert [fault[:29] for fault in images.metadata(file, True)[0]] == ["its EXIF orientation is 6, wh"] * (
        place != "none"
    )


def test_sixteen_bits_are_kept_whatever_a_file_is_called(tmp_path: Path) -> None:
    """Pillow clips 16-bit grey values to 8 bits without a word."""
    values = np.linspace(0, 65535, 480).astype(np.uint16).reshape(20, 24)
    for kind in (".png", ".tif"):
        _, data = cv2.imencode(kind, values)
        for ending in ENDINGS:
            (tmp_path / f"a{ending}").write_bytes(data.tobytes())
            found = pictures.read_mask(tmp_path / f"a{ending}")
            np.testing.assert_allclose(found, values / 65535, atol=1e-6)
    (tmp_path / "a.ppm").write_bytes(b"P5\n24 20\n65535\n" + values.astype(">u2").tobytes())
    with pytest.raises(InputError, match="expected 8 bits a channel"):
        pictures.read(tmp_path / "a.ppm")


def test_a_deflated_tiff_takes_what_its_pixels_take(tmp_path: Path) -> None:
    """Just below the limit for its bytes: 33 million values of zeros."""
    side = 3_300
    strip = zlib.compress(bytes(side * side * 3), 9)
    (tmp_path / "a.tif").write_bytes(_tiff(side, side, strip))
    assert pictures.read(tmp_path / "a.tif").values.shape == (side, side, 3)
    (tmp_path / "a.tif").write_bytes(_tiff(4 * side, side, strip))
    with pytest.raises(InputError, match="if that is right, save it without compression"):
        pictures.read(tmp_path / "a.tif")
