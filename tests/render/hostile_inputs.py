"""Scenes, meshes, pictures, arrays and problem files that somebody made to do harm, each written into an empty folder."""

from __future__ import annotations

import gzip
import os
import socket
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import unrender as ur
from unrender.io import images, volumes

__all__ = [
    "INPUTS",
    "SCENE",
    "Hostile",
    "names_archive",
    "ply",
    "png",
    "problem",
    "scene",
    "serialized",
    "warm_up",
    "write_scene",
]

Hostile = Callable[[Path], Callable[[], Any]]
"""Writes files into a folder, and returns the call that takes them in."""

SCENE = """<scene version="3.0.0">{head}
    <sensor type="perspective"><film type="hdrfilm">
        <integer name="width" value="6"/><integer name="height" value="4"/></film></sensor>
    <emitter type="constant"/>
    <shape type="rectangle" id="wall"><bsdf type="diffuse">{bsdf}</bsdf></shape>
    {body}
</scene>
"""
KEY = "wall.bsdf.reflectance.value"
GREY = '<rgb name="reflectance" value="0.2"/>'


def scene(head: str = "", bsdf: str = GREY, body: str = "") -> str:
    """An XML scene: a wall under an even sky, with more in it."""
    return SCENE.format(head=head, bsdf=bsdf, body=body)


def write_scene(folder: Path, text: str, name: str = "scene.xml") -> Path:
    """Write a scene and a reference for it. Returns its path."""
    (folder / name).write_text(text)
    np.save(folder / "photo.npy", np.full((4, 6, 3), 0.5, np.float32))
    return folder / name


def problem(folder: Path, given: Any = None, key: str = KEY, **options: Any) -> Callable[[], ur.Problem]:
    """Opens the folder's scene as a problem."""
    given = folder / "scene.xml" if given is None else given
    return lambda: ur.Problem(given, [ur.Parameter(key)], [ur.View(folder / "photo.npy")], **options)


def warm_up(place: Path, names: Sequence[str]) -> None:
    """What is done once in a process is no input's doing."""
    del names
    write_scene(place, scene())
    problem(place)()


def _xml(head: str = "", bsdf: str = GREY, body: str = "") -> Hostile:
    def write(folder: Path) -> Callable[[], Any]:
        write_scene(folder, scene(head, bsdf, body))
        return problem(folder)

    return write


def _shape(kind: str, name: str, data: bytes, more: str = "") -> Hostile:
    """A scene with a shape of a file."""

    def write(folder: Path) -> Callable[[], Any]:
        (folder / name).write_bytes(data)
        return _xml(body=f'<shape type="{kind}"><string name="filename" value="{name}"/>{more}</shape>')(folder)

    return write


def _texture(name: str, data: bytes) -> Hostile:
    def write(folder: Path) -> Callable[[], Any]:
        (folder / name).write_bytes(data)
        inner = f'<texture type="bitmap" name="reflectance"><string name="filename" value="{name}"/></texture>'
        return _xml(bsdf=inner)(folder)

    return write


def _picture(name: str, data: bytes | Callable[[], bytes]) -> Hostile:
    def write(folder: Path) -> Callable[[], Any]:
        (folder / name).write_bytes(data if isinstance(data, bytes) else data())
        return lambda: images.read(folder / name)

    return write


def _grid(data: bytes) -> Hostile:
    def write(folder: Path) -> Callable[[], Any]:
        (folder / "a.vol").write_bytes(data)
        volume = '<volume type="gridvolume" name="sigma_t"><string name="filename" value="a.vol"/></volume>'
        cube = f'<shape type="cube"><medium type="heterogeneous" name="interior">{volume}</medium></shape>'
        return _xml(body=cube)(folder)

    return write


# ---------------------------------------------------------------------- formats


def ply(
    faces: Any = ((3, 0, 1, 2),),
    vertices: int = 3,
    form: str = "binary_little_endian",
    counts: tuple[int, int] | None = None,
) -> bytes:
    """A PLY file of a triangle, or what its header says."""
    declared = counts or (vertices, len(faces))
    header = (
        f"ply\nformat {form} 1.0\nelement vertex {declared[0]}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {declared[1]}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    points = np.eye(3, dtype=np.float32)[np.arange(vertices) % 3]
    if form == "ascii":
        rows = [" ".join(map(str, row)) for row in [*points.tolist(), *faces]]
        return (header + "\n".join(rows) + "\n").encode()
    order = "<" if "little" in form else ">"
    body = points.astype(f"{order}f4").tobytes()
    return header.encode() + body + b"".join(struct.pack(f"{order}B3i", *face) for face in faces)


def serialized(
    vertices: int = 3, faces: Any = ((0, 1, 2),), counts: tuple[int, int] | None = None, fill: float = 1.0
) -> bytes:
    """A file of Mitsuba's serialized format, version 4."""
    declared = counts or (vertices, len(faces))
    points = np.full((vertices, 3), fill, "<f4") * np.arange(vertices)[:, None]
    body = struct.pack("<I", 0x1000) + b"m\0" + struct.pack("<QQ", *declared) + points.astype("<f4").tobytes()
    body += np.array(faces, "<u4").tobytes()
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1)


def png(width: int, height: int, data: bytes = bytes(99), kind: int = 2) -> bytes:
    """A PNG file that declares this size."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    header = struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def exr(window: tuple[int, int, int, int], channels: str = "BGR") -> bytes:
    """An OpenEXR file of zeros, uncompressed half floats, with this data window."""

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value

    listed = b"".join(c.encode() + b"\0" + struct.pack("<iiii", 1, 0, 1, 1) for c in channels) + b"\0"
    box = struct.pack("<4i", *window)
    header = (
        b"\x76\x2f\x31\x01" + struct.pack("<I", 2) + attribute("channels", "chlist", listed)
        + attribute("compression", "compression", b"\0") + attribute("dataWindow", "box2i", box)
        + attribute("displayWindow", "box2i", box) + attribute("lineOrder", "lineOrder", b"\0")
        + attribute("pixelAspectRatio", "float", struct.pack("<f", 1)) + attribute("screenWindowCenter", "v2f", bytes(8))
        + attribute("screenWindowWidth", "float", struct.pack("<f", 1)) + b"\0"
    )  # fmt: skip
    width, height = window[2] - window[0] + 1, window[3] - window[1] + 1
    row = 2 * len(channels) * width
    first = len(header) + 8 * height
    table = b"".join(struct.pack("<Q", first + y * (8 + row)) for y in range(height))
    rows = b"".join(struct.pack("<ii", window[1] + y, row) + bytes(row) for y in range(height))
    return header + table + rows


def vol(x: int, y: int, z: int, channels: int = 1, data: bytes = b"", kind: int = 1) -> bytes:
    """A grid file that declares this size."""
    return struct.pack("<4s5i6f", b"VOL\3", kind, x, y, z, channels, *range(6)) + data


def tga(width: int, height: int, kind: int = 2, data: bytes = b"") -> bytes:
    """A TGA file with the footer by which Mitsuba knows one. Mitsuba takes the third byte for the kind."""
    head = struct.pack("<3B9xHHBB", 0, 0, kind, width, height, 24, 0)
    return head + data + bytes(8) + b"TRUEVISION-XFILE.\0"


def names_archive(count: int) -> bytes:
    """An archive with so many members of no bytes, written by hand: `zipfile` would take minutes."""
    local, central = bytearray(), bytearray()
    for number in range(count):
        name = b"%x.npy" % number
        central += (
            struct.pack("<4s6H3L5H2L", b"PK\1\2", 20, 20, 0, 0, 0, 0, 0, 0, 0, len(name), 0, 0, 0, 0, 0, len(local))
            + name
        )
        if number == 0:
            local += struct.pack("<4s5H3L2H", b"PK\3\4", 20, 0, 0, 0, 0, 0, 0, 0, len(name), 0) + name
    short = min(count, 0xFFFF)
    return bytes(local + central) + struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, short, short, len(central), len(local), 0)


# ---------------------------------------------------------------------- what is no regular file


def _special(make: Callable[[Path], Any], use: Callable[[Path, Path], Callable[[], Any]]) -> Hostile:
    def write(folder: Path) -> Callable[[], Any]:
        place = folder / "thing"
        make(place)
        return use(folder, place)

    return write


def _socket(place: Path) -> None:
    here = os.getcwd()
    os.chdir(place.parent)  # a socket's path is short
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(place.name)
    finally:
        os.chdir(here)


def _device(place: Path) -> None:
    place.symlink_to("/dev/zero")


def _as_reference(ending: str) -> Callable[[Path, Path], Callable[[], Any]]:
    def use(folder: Path, place: Path) -> Callable[[], Any]:
        write_scene(folder, scene())
        named = place.rename(folder / f"reference{ending}")
        return lambda: ur.Problem(folder / "scene.xml", [ur.Parameter(KEY)], [ur.View(named)])

    return use


def _as_initial(ending: str) -> Callable[[Path, Path], Callable[[], Any]]:
    def use(folder: Path, place: Path) -> Callable[[], Any]:
        write_scene(folder, scene())
        named = place.rename(folder / f"initial{ending}")
        view = ur.View(folder / "photo.npy")
        return lambda: ur.Problem(folder / "scene.xml", [ur.Parameter(KEY, initial=named)], [view])

    return use


def _as_scene(folder: Path, place: Path) -> Callable[[], Any]:
    write_scene(folder, scene())
    return problem(folder, place.rename(folder / "other.xml"))


def _as_problem_file(folder: Path, place: Path) -> Callable[[], Any]:
    return lambda: ur.Problem.from_file(place.rename(folder / "problem.toml"))


def _as_element(text: str) -> Callable[[Path, Path], Callable[[], Any]]:
    """Named by an element of the scene."""
    return lambda folder, _: _xml(body=text)(folder)


def _as_spectrum(folder: Path, place: Path) -> Callable[[], Any]:
    place.rename(folder / "a.spd")
    return _xml(bsdf='<spectrum name="reflectance" filename="a.spd"/>')(folder)


_PLY = '<shape type="ply"><string name="filename" value="thing"/></shape>'
_ENVMAP = '<emitter type="envmap"><string name="filename" value="thing"/></emitter>'
_INCLUDE = '<include filename="thing"/>'

# ---------------------------------------------------------------------- scenes


def _files(text: str, **files: str) -> Hostile:
    """A scene in a folder, with other files beside it; names may lead out of the scene's folder."""

    def write(folder: Path) -> Callable[[], Any]:
        inside = folder / "inside"
        inside.mkdir()
        (folder / "secret.xml").write_text('<scene version="3.0.0"><emitter type="constant"/></scene>')
        for name, content in files.items():
            path = inside / name.replace("__", "/").replace("_xml", ".xml")
            path.parent.mkdir(exist_ok=True)
            path.write_text(content)
        write_scene(inside, text)
        return problem(inside)

    return write


def _dictionary(**entries: Any) -> Hostile:
    def write(folder: Path) -> Callable[[], Any]:
        write_scene(folder, scene())
        given = {
            "type": "scene",
            "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 6, "height": 4}},
            "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.2}}},
        }
        made = {key: value(folder) if callable(value) else value for key, value in entries.items()}
        return problem(folder, {**given, **made})

    return write


def _doubling(levels: int) -> str:
    """Parameters, each twice the one before."""
    lines = ['<default name="p0" value="0123456789"/>']
    lines += [f'<default name="p{n}" value="$p{n - 1}$p{n - 1}"/>' for n in range(1, levels)]
    return "".join(lines)


def _twice(levels: int) -> str:
    """Materials of two halves, which are both the material before."""
    half = '<float name="weight" value="0.5"/><ref id="b{n}" name="x"/><ref id="b{n}" name="y"/>'
    lines = [f'<bsdf type="blendbsdf" id="b{n}">{half.format(n=n - 1)}</bsdf>' for n in range(1, levels)]
    return f'<bsdf type="diffuse" id="b0"/>{"".join(lines)}<shape type="sphere"><ref id="b{levels - 1}"/></shape>'


def _long(**fields: Any) -> Hostile:
    """A problem file with a field that is out of bounds."""

    def write(folder: Path) -> Callable[[], Any]:
        write_scene(folder, scene())
        head = {"scene": '"scene.xml"', "max_depth": "2"} | fields.get("head", {})
        key, view = fields.get("key", f'"{KEY}"'), fields.get("view", '"photo.npy"')
        text = "\n".join(f"{name} = {value}" for name, value in head.items())
        text += f"\n[[parameters]]\nkey = {key}\n{fields.get('parameter', '')}\n[[views]]\nreference = {view}\n"
        (folder / "problem.toml").write_text(text)
        return lambda: ur.Problem.from_file(folder / "problem.toml")

    return write


def _text(text: str | bytes) -> Hostile:
    """A problem file."""

    def write(folder: Path) -> Callable[[], Any]:
        (folder / "problem.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
        return lambda: ur.Problem.from_file(folder / "problem.toml")

    return write


_NAME = "A" * 5000
_ZEROS = b"\0" * (1 << 20)


def _archive(data: Callable[[], bytes]) -> Hostile:
    def write(folder: Path) -> Callable[[], Any]:
        (folder / "a.npz").write_bytes(data())
        return lambda: volumes.read_grid(folder / "a.npz")

    return write


def _bomb_npz(folder: Path) -> Callable[[], Any]:
    head = b"{'descr': '|u1', 'fortran_order': False, 'shape': (1, 1, 4294967296), }\n"
    with zipfile.ZipFile(folder / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as member:
        member.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head)
        for _ in range(64):
            member.write(_ZEROS)
    return lambda: volumes.read_grid(folder / "a.npz")


def _obj_chain() -> bytes:
    corners = b"".join(b"f 1/%d 2/1 3/1\n" % (n + 1) for n in range(20_000))
    return b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + b"vt 0 0\n" * 20_001 + corners


def _splats(properties: str, data: bytes) -> bytes:
    return f"ply\nformat binary_little_endian 1.0\nelement vertex 1\n{properties}end_header\n".encode() + data


_DOUBLES = "".join(
    f"property double {name}\n"
    for name in ["x", "y", "z", "nx", "ny", "nz", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)
_TENSORS = b"tensor_file\0\1\0" + struct.pack("<IH", 1, 7) + b"theta_i" + struct.pack("<HBQQ", 1, 10, 1 << 40, 1 << 20)
_MEASURED = '<bsdf type="measured"><string name="filename" value="thing"/></bsdf>'


def _measured(folder: Path) -> Callable[[], Any]:
    (folder / "thing").write_bytes(_TENSORS)
    return _xml(body=f'<shape type="sphere">{_MEASURED}</shape>')(folder)


def _many_textures(folder: Path) -> Callable[[], Any]:
    (folder / "a.png").write_bytes(png(5000, 5000, bytes(75_005_000)))
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="a.png"/></texture>'
    shape = f'<shape type="sphere"><bsdf type="diffuse">{texture}</bsdf></shape>'
    return _xml(body=40 * shape)(folder)


def _gzip(folder: Path) -> Callable[[], Any]:
    (folder / "scene.xml").write_bytes(gzip.compress(_ZEROS))
    np.save(folder / "photo.npy", np.zeros((4, 6, 3), np.float32))
    return problem(folder)


def _mesh_dictionary(folder: Path) -> dict[str, Any]:
    (folder / "a.ply").write_bytes(ply(((3, 0, 1, 1 << 30),)))
    return {"type": "ply", "filename": str(folder / "a.ply")}


def _picture_dictionary(folder: Path) -> dict[str, Any]:
    (folder / "a.hdr").write_bytes(png(60_000, 60_000))
    return {"type": "envmap", "filename": folder / "a.hdr"}


_PLY_TWICE = ply().replace(b"element face", b"element vertex 1\nproperty float x\nelement face")
_BMP = b"BM" + struct.pack("<IIIIiiHHIIiiII", 64, 0, 54, 40, 60_000, -60_000, 1, 24, *[0] * 6)
_TWO_SIZES = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n-Y 00000000060000 +X 60000\n-Y 4 +X 4\n" + bytes(64)
_MATERIAL = '<bsdf type="conductor"><string name="material" value="../../x"/></bsdf>'
_FACE = ((3, 0, 1, 70_000_000),)

INPUTS: dict[str, Hostile] = {
    # what is no regular file
    "a pipe as a scene": _special(os.mkfifo, _as_scene),
    "a pipe as a problem file": _special(os.mkfifo, _as_problem_file),
    "a pipe as an include": _special(os.mkfifo, _as_element(_INCLUDE)),
    "a pipe as a mesh": _special(os.mkfifo, _as_element(_PLY)),
    "a pipe as a texture": _special(os.mkfifo, _as_element(_ENVMAP)),
    "a pipe as a spectrum": _special(os.mkfifo, _as_spectrum),
    "a pipe as a reference": _special(os.mkfifo, _as_reference(".exr")),
    "a pipe as an array": _special(os.mkfifo, _as_initial(".npy")),
    "a pipe as an archive": _special(os.mkfifo, _as_initial(".npz")),
    "a pipe as a grid": _special(os.mkfifo, _as_initial(".vol")),
    "a device as a reference": _special(_device, _as_reference(".npy")),
    "a device as a mesh": _special(_device, _as_element(_PLY)),
    "a device as a scene": _special(_device, _as_scene),
    "a device as a problem file": _special(_device, _as_problem_file),
    "a socket as a mesh": _special(_socket, _as_element(_PLY)),
    "a socket as a reference": _special(_socket, _as_reference(".png")),
    "a folder as a mesh": _special(Path.mkdir, _as_element(_PLY)),
    "a folder as a texture": _special(Path.mkdir, _as_element(_ENVMAP)),
    "a folder as an include": _special(Path.mkdir, _as_element(_INCLUDE)),
    "a folder as a scene": _special(Path.mkdir, _as_scene),
    # meshes
    "a PLY of a vertex that is not there": _shape("ply", "a.ply", ply(_FACE)),
    "a PLY of a negative vertex": _shape("ply", "a.ply", ply(((3, 0, 1, -1),))),
    "a big-endian PLY of a vertex that is not there": _shape("ply", "a.ply", ply(_FACE, form="binary_big_endian")),
    "a PLY in text of a vertex that is not there": _shape("ply", "a.ply", ply(_FACE, form="ascii")),
    "a PLY in text whose rows slip": _shape("ply", "a.ply", ply(((3, 0, 1, "2.0"),), form="ascii")),
    "a PLY of billions of vertices": _shape("ply", "a.ply", ply(counts=(4_294_967_299, 1))),
    "a PLY of billions of faces": _shape("ply", "a.ply", ply(counts=(3, 4_294_967_297))),
    "a PLY of quads": _shape("ply", "a.ply", ply(((4, 0, 1, 2),))),
    "a PLY of faces alone": _shape("ply", "a.ply", ply(vertices=0)),
    "a PLY with vertices twice": _shape("ply", "a.ply", _PLY_TWICE),
    "a PLY without end": _shape("ply", "a.ply", b"ply\nformat ascii 1.0\n" + b"comment a\n" * 100_000),
    "a PLY with ESC in a name": _shape("ply", "a.ply", ply().replace(b"float x", b"float \x1b]0;x\x07").replace(b"float y", b"float x")),
    "splats of double precision": _shape("ellipsoids", "a.ply", _splats(_DOUBLES, bytes(13 * 8))),
    "splats of nothing": _shape("ellipsoids", "a.ply", b"ply\nformat binary_little_endian 1.0\nend_header\n"),
    "a serialized mesh of a vertex that is not there": _shape("serialized", "a.serialized", serialized(faces=((0, 1, 9_000_000),))),
    "a serialized mesh of billions of faces": _shape("serialized", "a.serialized", serialized(counts=(3, 1_431_655_766))),
    "a serialized mesh that is cut short": _shape("serialized", "a.serialized", serialized(counts=(300, 1))),
    "a serialized mesh of NaN": _shape("serialized", "a.serialized", serialized(fill=float("nan"))),
    "a serialized mesh of no such index": _shape("serialized", "a.serialized", serialized(), '<integer name="shape_index" value="7"/>'),
    "an OBJ of twenty thousand variants of a vertex": _shape("obj", "a.obj", _obj_chain()),
    "a mesh at an address in memory": _xml(body='<shape type="blender"><integer name="verts" value="4096"/></shape>'),
    "a dictionary's PLY of a vertex that is not there": _dictionary(mesh=_mesh_dictionary),
    "tensors that lead out of their file": _measured,
    # pictures
    "a texture of 60000 x 60000": _texture("a.png", png(60_000, 60_000)),
    "a texture of 60000 x 60000 named .exr": _texture("a.exr", png(60_000, 60_000)),
    "a PNG named .hdr": _picture("a.hdr", png(60_000, 60_000)),
    "a PNG named .pfm": _picture("a.pfm", png(60_000, 60_000)),
    "a PNG of zeros": _picture("a.png", lambda: png(9000, 9000, bytes(9000 * 27_001))),
    "a BMP named .png": _picture("a.png", _BMP),
    "an HDR with two resolutions": _picture("a.hdr", _TWO_SIZES),
    "a TGA of negative width": _picture("a.tga", tga(65_535, 1)),
    "a TGA whose runs go on": _picture("a.tga", tga(2, 2, 10, b"\xff\1\2\3")),
    "an EXR before its origin": _picture("a.exr", exr((-5, 0, 2, 3))),
    "an EXR far from its origin": _picture("a.exr", exr((0, 1 << 29, 7, (1 << 29) + 3))),
    "a dictionary's sky of 60000 x 60000": _dictionary(sky=_picture_dictionary),
    "forty textures of 75 million values": _many_textures,
    # grids and arrays
    "a grid of a trillion voxels": _grid(vol(10_000, 10_000, 10_000)),
    "a grid of negative size": _grid(vol(-1, 1, 1)),
    "a grid that is cut short": _grid(vol(4, 4, 4, data=bytes(16))),
    "an archive of 400000 names": _archive(lambda: names_archive(400_000)),
    "an archive of four gigabytes of zeros": _bomb_npz,
    # scenes
    "an include by the beginning of a name": _files(
        scene(head='<default name="a" value="../secret.xm"/><include filename="$al"/>')
    ),
    "an include by a parameter that a longer one hides": _files(
        scene(head='<default name="abc" value="inner"/><default name="ab" value="../secre"/><include filename="$abt.xml"/>'),
    ),
    "an include that is elsewhere from where it is": _files(
        scene(head='<include filename="sub/a.xml"/>'),
        b_xml='<scene version="3.0.0"/>',
        sub__a_xml='<scene version="3.0.0"><include filename="b.xml"/></scene>',
        sub__b_xml='<scene version="3.0.0"><include filename="../../secret.xml"/></scene>',
    ),
    "an include by a search path": _files(scene(head='<path value=".."/><include filename="secret.xml"/>')),
    "parameters that double": _xml(head=_doubling(40), body='<shape type="sphere" id="$p39"/>'),
    "an undefined parameter": _xml(head='<include filename="$nowhere"/>'),
    "a thousand includes": _files(
        scene(head='<include filename="a.xml"/>'), a_xml='<scene version="3.0.0">' + 1001 * '<include filename="b.xml"/>' + "</scene>",
        b_xml='<scene version="3.0.0"/>',
    ),
    "materials that hold the one before twice": _xml(body=_twice(40)),
    "a spectrum that is no text": _xml(bsdf='<spectrum name="reflectance" filename="/bin/sh"/>'),
    "a material that leads elsewhere": _xml(body=f'<shape type="sphere">{_MATERIAL}</shape>'),
    "a compressed scene": _gzip,
    "a type that leads elsewhere": _xml(body='<shape type="../../tmp/x"/>'),
    "a type at an absolute place": _xml(body='<shape type="/tmp/x"/>'),
    "a name of 5000 characters as a file": _xml(body=f'<shape type="ply"><string name="filename" value="{_NAME}"/></shape>'),
    "a name of 5000 characters as an include": _xml(head=f'<include filename="{_NAME}"/>'),
    # problem files
    "a name of 5000 characters": _long(head={"name": f'"{_NAME}"'}),
    "a key of 5000 characters": _long(key=f'"{_NAME}"'),
    "a reference of 5000 characters": _long(view=f'"{_NAME}"'),
    "a scene of 5000 characters": _long(head={"scene": f'"{_NAME}.xml"'}),
    "an initial value of 5000 characters": _long(parameter=f'initial = "{_NAME}.npy"'),
    "a path of 2**32 segments": _long(head={"max_depth": str(2**32)}),
    "a path of 2**64 segments": _long(head={"max_depth": "18446744073709551616"}),
    "a key of half a million parts": _text("a." * 250_000 + "b = 1\n"),
    "a list of a hundred thousand lines": _text('scene = "x.xml"\nextra = [\n' + "1,\n" * 100_000 + "]\n"),
    "a hundred megabytes of problem file": _text(b"#" * 100_000_000),
}  # fmt: skip
