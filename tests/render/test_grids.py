"""Grid files: what they hold comes back, as a start or a truth of a parameter too, and broken ones are one line."""

from __future__ import annotations

import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import unrender as ur
from unrender.core.errors import InputError
from unrender.io import parameter_values as values
from unrender.io.volumes import read_grid, write_grid

GRID = np.random.default_rng(0).random((4, 3, 5, 2)).astype(np.float32)


# ---------------------------------------------------------------------- there and back


@pytest.mark.parametrize("ending", [".vol", ".npy", ".npz"])
@pytest.mark.parametrize("channels", [1, 2, 3])
def test_grids_come_back(tmp_path: Path, ending: str, channels: int) -> None:
    given = np.random.default_rng(1).random((4, 3, 5, channels)).astype(np.float32)
    path = write_grid(tmp_path / f"a{ending}", given)
    np.testing.assert_array_equal(read_grid(path).values, given)
    assert list(tmp_path.iterdir()) == [path]
    if ending == ".vol":
        np.testing.assert_array_equal(np.array(mi.VolumeGrid(str(path))).reshape(given.shape), given)
        mi.VolumeGrid(given).write(str(tmp_path / "theirs.vol"))
        assert (tmp_path / "theirs.vol").read_bytes() == path.read_bytes()


def test_a_file_of_others_is_written_back_bit_for_bit(assets: Path, tmp_path: Path) -> None:
    path = assets / "tutorials" / "volume.vol"
    grid = read_grid(path)
    assert grid.values.shape == (53, 45, 44, 1)
    assert grid.box != (0, 0, 0, 1, 1, 1)
    np.testing.assert_array_equal(grid.values[..., 0], np.array(mi.VolumeGrid(str(path))))
    assert write_grid(tmp_path / "again.vol", grid.values, grid.box).read_bytes() == path.read_bytes()
    theirs = write_grid(tmp_path / "theirs.vol", mi.VolumeGrid(str(path)))
    assert theirs.read_bytes() == path.read_bytes()


def test_arrays_without_channels_have_one(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", GRID[..., 0].astype(np.float64))
    assert read_grid(tmp_path / "a.npy").values.shape == (4, 3, 5, 1)
    assert read_grid(write_grid(tmp_path / "a.vol", GRID[..., 0])).values.shape == (4, 3, 5, 1)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_integers_of_few_bits_are_refused_as_for_parameters(tmp_path: Path, kind: Any) -> None:
    """A density of 200 stood for 0.78, and the same file as a parameter's value was refused."""
    flags = (GRID > 0.5).astype(kind)
    path = write_grid(tmp_path / "flags.npy", flags)
    np.testing.assert_array_equal(read_grid(path).values, flags)
    np.save(tmp_path / "levels.npy", 200 * flags)
    words = r"expected linear values, got integers of 8 or 16 bits up to 200, .* to linear floating-point values$"
    with pytest.raises(InputError, match=rf"levels\.npy: {words}"):
        read_grid(tmp_path / "levels.npy")
    with pytest.raises(InputError, match=rf"a\.vol: {words}"):
        write_grid(tmp_path / "a.vol", 200 * flags)


@pytest.mark.parametrize("path", [None, 3, [1], ""])
def test_paths_of_grids_of_another_kind_are_one_line(path: Any) -> None:
    with pytest.raises(InputError, match=r"^read_grid: expected a file, got "):
        read_grid(path)
    with pytest.raises(InputError, match=r"^write_grid: expected a file, got "):
        write_grid(path, GRID)


@pytest.mark.parametrize(
    ("name", "values", "box", "message"),
    [
        ("a.txt", GRID, None, "unknown kind of grid, expected one of .vol, .npy, .npz"),
        ("a.vol", GRID[0, 0], None, r"expected a grid of shape \(Z, Y, X, C\), got \(5, 2\)"),
        ("a.vol", GRID[:0], None, r"expected a grid of shape \(Z, Y, X, C\), got \(0, 3, 5, 2\)"),
        ("a.vol", GRID, (0, 0, 0, 1, 1), "box: expected six finite numbers"),
        ("a.npy", np.where(GRID > 0.5, np.nan, GRID), None, "values are NaN or infinite"),
    ],
)
def test_what_is_no_grid_is_not_written(tmp_path: Path, name: str, values: Any, box: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        write_grid(tmp_path / name, values, *([box] if box else []))
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------------- malformed on purpose


def vol(
    sizes: tuple[int, ...] = (5, 3, 4, 2),
    data: bytes | None = None,
    magic: bytes = b"VOL\3",
    kind: int = 1,
    box: tuple[float, ...] = (0, 0, 0, 1, 1, 1),
) -> bytes:
    return struct.pack("<4s5i6f", magic, kind, *sizes, *box) + (GRID.tobytes() if data is None else data)


def npz(path: Path, **members: bytes) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)


def npy(shape: str, body: bytes = b"", descr: str = "<f4") -> bytes:
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


BAD = GRID.copy()
BAD[1, 2, 3, 1] = np.nan
HOSTILE: dict[str, tuple[str, Callable[[Path], Any], str]] = {
    "nothing": ("a.vol", lambda p: p.write_bytes(b""), "it does not begin with VOL"),
    "a picture": ("a.vol", lambda p: p.write_bytes(b"\x89PNG" + bytes(99)), "it does not begin with VOL"),
    "half a header": ("a.vol", lambda p: p.write_bytes(vol()[:40]), "cut short: 40 bytes, its header alone has 48"),
    "another version": ("a.vol", lambda p: p.write_bytes(vol(magic=b"VOL\2")), "expected version 3 of the format, got 2"),
    "bytes for numbers": ("a.vol", lambda p: p.write_bytes(vol(kind=3)), "expected float32 numbers, got uint8"),
    "an unknown type": ("a.vol", lambda p: p.write_bytes(vol(kind=-9)), "got the unknown type -9"),
    "cut short": ("a.vol", lambda p: p.write_bytes(vol()[:-1]), "declares 480 bytes of numbers, there are 479"),
    "too long": ("a.vol", lambda p: p.write_bytes(vol() + b"\0"), "declares 480 bytes of numbers, there are 481"),
    "an absurd size": ("a.vol", lambda p: p.write_bytes(vol((2**31 - 1,) * 4)), "expected at most 268435456 values"),
    "a large size": ("a.vol", lambda p: p.write_bytes(vol((640, 640, 640, 1))), "declares 1048576000 bytes of numbers, there"),
    "a negative size": ("a.vol", lambda p: p.write_bytes(vol((-5, -3, 4, 2))), "expected at least one of each"),
    "no channels": ("a.vol", lambda p: p.write_bytes(vol((5, 3, 4, 0))), "of 0 channels, expected at least one"),
    "NaN": ("a.vol", lambda p: p.write_bytes(vol(data=BAD.tobytes())), "1 values are NaN or infinite, the first at index (1, 2, 3, 1)"),
    "a box without end": ("a.vol", lambda p: p.write_bytes(vol(box=(0, 0, 0, np.inf, 1, 1))), "its box is not finite"),
    "not there": ("b.vol", lambda p: None, "no such file"),
    "a folder": ("a.vol", lambda p: p.mkdir(), "not a file"),
    "a pickle": ("a.npy", lambda p: np.save(p, np.array([{}], object), allow_pickle=True), "expected real numbers, got object"),
    "an absurd shape": ("a.npy", lambda p: p.write_bytes(npy("(1099511627776, 4, 4, 4)")), ", 281474976710656 bytes; 0 follow"),
    "a flat array": ("a.npy", lambda p: np.save(p, GRID.ravel()), "expected a grid of shape (Z, Y, X, C), got (120,)"),
    "NaN in NumPy": ("a.npy", lambda p: np.save(p, BAD), "1 values are NaN"),
    "beyond float32": ("a.npy", lambda p: np.save(p, np.full((2, 2, 2), 1e300)), "8 values are NaN or infinite"),
    "complex": ("a.npy", lambda p: np.save(p, GRID * 1j), "expected real numbers"),
    "two arrays": ("a.npz", lambda p: np.savez(p, allow_pickle=False, a=GRID, b=GRID), "expected an archive of one array, got 2"),
    "no array": ("a.npz", lambda p: npz(p), "expected an archive of one array, got 0"),
    "a pickle in an archive": ("a.npz", lambda p: np.savez(p, a=np.array([{}], object)), "expected real numbers, got object"),
    "no archive": ("a.npz", lambda p: p.write_bytes(b"no"), "not an .npz archive"),
    "a bomb": ("a.npz", lambda p: npz(p, a=npy("(99, 1000, 1000)", bytes(99_000_000), "|u1")), "its arrays have 99000080 bytes"),
    "one for nobody": ("a.npz", lambda p: npz(p, a=npy("(60, 1000, 1000)", bytes(60_000_000), "|u1")), "suits nobody"),
    "a text": ("a.txt", lambda p: p.write_text("VOL"), "unknown kind of grid"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_grid_is_one_line_and_takes_no_memory(tmp_path: Path, name: str) -> None:
    file, make, message = HOSTILE[name]
    make(tmp_path / file)

    def small(shape: tuple[int, ...]) -> None:
        if name == "one for nobody":
            assert shape == (60, 1000, 1000, 1)
            raise InputError("suits nobody")

    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught:
            read_grid(tmp_path / file, small)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()
    assert str(caught.value).startswith(f"{tmp_path / file}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------------- as a parameter's value


def test_a_grid_fills_a_parameter(tmp_path: Path) -> None:
    for ending in (".vol", ".npy", ".npz"):
        array, notice = values.fill(write_grid(tmp_path / f"a{ending}", GRID), GRID.shape)
        np.testing.assert_array_equal(array, GRID)
        assert notice == ""


def test_a_vol_file_is_scaled_and_an_array_is_not(tmp_path: Path) -> None:
    path = write_grid(tmp_path / "a.vol", np.full((4, 6, 8, 1), 0.25))
    array, notice = values.fill(path, (3, 6, 16, 1))
    np.testing.assert_allclose(array, np.full((3, 6, 16, 1), 0.25), rtol=1e-6)
    assert notice == "a.vol: scaled from 8x6x4 to 16x6x3 voxels"
    np.save(tmp_path / "a.npy", np.ones((4, 6, 8, 1)))
    with pytest.raises(
        InputError, match=r"a\.npy: expected .* shape \(3, 6, 16, 1\), got an array of shape \(4, 6, 8, 1\)"
    ):
        values.fill(tmp_path / "a.npy", (3, 6, 16, 1))


MISFITS = [
    ((4, 3, 5, 3), "a grid of 2 channels cannot fill a parameter of 3"),
    ((4, 3, 2), r"a grid cannot fill a parameter of shape \(4, 3, 2\)"),
    ((3,), r"a grid cannot fill a parameter of shape \(3,\), expected a number or 3 numbers"),
]


@pytest.mark.parametrize(("shape", "message"), MISFITS)
def test_a_grid_that_does_not_suit_is_refused_by_its_header(tmp_path: Path, shape: Any, message: str) -> None:
    path = tmp_path / "a.vol"
    path.write_bytes(vol(data=b""))  # the header alone
    with pytest.raises(InputError, match=rf"^{path}: {message}"):
        values.fill(path, shape)


SCENE = """<scene version="3.0.0">
    <sensor type="perspective"><transform name="to_world"><lookat origin="0, 0, 5" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/><rfilter type="box"/></film>
    </sensor>
    <emitter type="constant"/>
    <shape type="cube" id="smoke"><bsdf type="null"/>
        <medium type="heterogeneous" name="interior">
            <volume type="gridvolume" name="sigma_t"><string name="filename" value="scene.vol"/></volume>
        </medium>
    </shape>
</scene>
"""
KEY = "smoke.interior_medium.sigma_t.data"


def problem(folder: Path, initial: str, truth: str) -> Path:
    (folder / "smoke.xml").write_text(SCENE)
    write_grid(folder / "scene.vol", np.full((4, 4, 4, 1), 0.5))
    mi.Bitmap(np.ones((4, 4, 3), np.float32)).write(str(folder / "photo.exr"))
    path = folder / "problem.toml"
    path.write_text(
        f'scene = "smoke.xml"\n[[parameters]]\nkey = "{KEY}"\ninitial = "{initial}"\ntruth = "{truth}"\n'
        '[[views]]\nreference = "photo.exr"\n'
    )
    return path


@pytest.mark.slow
@pytest.mark.usefixtures("short_ends")
def test_problem_files_name_grids_and_run_folders_keep_them(tmp_path: Path) -> None:
    start, truth = (np.random.default_rng(seed).random((4, 4, 4, 1)).astype(np.float32) for seed in (1, 2))
    (tmp_path / "grids").mkdir()
    write_grid(tmp_path / "grids" / "start.vol", start)
    write_grid(tmp_path / "grids" / "truth.npz", truth)
    found = ur.Problem.from_file(problem(tmp_path, "grids/start.vol", "grids/truth.npz"))
    np.testing.assert_array_equal(found.initial()[KEY].numpy(), start)
    np.testing.assert_array_equal(found.truth[KEY], truth)
    assert not found.notices
    folder = tmp_path / "run"
    ur.optimize(found, ur.PathGradient(spp=2), ur.optimizers.Adam(), 1, run_directory=folder)
    (tmp_path / "problem.toml").rename(tmp_path / "moved.toml")  # so that the folder's own copy serves
    again = ur.resume(folder, steps=2)
    assert again.steps == 2
    np.testing.assert_array_equal(again.truth[KEY], truth)


def test_a_bad_grid_is_told_with_its_line(tmp_path: Path) -> None:
    path = problem(tmp_path, "start.vol", "truth.npz")
    (tmp_path / "start.vol").write_bytes(vol()[:-1])
    with pytest.raises(InputError) as caught:
        ur.Problem.from_file(path)
    said = str(caught.value)
    assert said.startswith(
        f"{path}:4: parameters[0].initial: {tmp_path / 'start.vol'}: a grid of 2 channels cannot fill"
    )
    write_grid(tmp_path / "start.vol", np.ones((2, 2, 2)))
    with pytest.raises(InputError, match=rf"toml:5: parameters\[0\]\.truth: {tmp_path / 'truth.npz'}: no such file"):
        ur.Problem.from_file(path)
