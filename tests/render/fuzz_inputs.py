"""Sound files of every kind that the package reads, damaged at random: the input of a name such as "mesh 17" is always the same.

`python tests/render/fuzz_inputs.py --seconds 600` takes in inputs until the time is over and prints a line for each that was neither
refused in one line nor taken: those whose process died or hung, raised anything but `InputError`, or took more than a gigabyte.
How files are damaged is in `fuzz_changes.py`.
"""

from __future__ import annotations

import argparse
import functools
import io
import json
import random
import shutil
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_changes import damaged
from hostile_inputs import KEY, Hostile, ply, scene, serialized, write_scene
from hostile_worker import Outcome, take_in

import unrender as ur
from unrender.app import report
from unrender.app.capture import formats, pictures
from unrender.app.capture.formats import lights
from unrender.app.evaluation.judge import judge
from unrender.app.evaluation.turntable import turntable
from unrender.app.exporting.scene_folder import export
from unrender.backend import variant
from unrender.core.errors import InputError
from unrender.io import bounded_files, images, volumes
from unrender.runs.folder import reader

__all__ = ["INPUTS", "TARGETS", "faults", "names", "warm_up"]

LARGEST = 1 << 30
"""Bytes that no input may take."""
LONGEST = 120.0
"""Seconds of the clock after which a process is ended, on a machine that others use, too."""
SLOWEST = 10.0
"""Processor seconds from which on an input counts as hung."""

_FEWEST, _REPORT = 20, 100.0
"""Least number of inputs of each target between two reports, and seconds that are aimed at."""

Files = dict[str, bytes]
Use = Callable[[Path, str], Any]
"""Takes in a folder of files, of which the named one is damaged."""

# ---------------------------------------------------------------------- sound files


@functools.cache
def _problem_files() -> Files:
    place = Path(tempfile.mkdtemp(prefix="fuzz"))
    write_scene(place, scene(body='<shape type="obj" id="mesh"><string name="filename" value="mesh.obj"/></shape>'))
    text = f"""name = "a"\nscene = "scene.xml"\nmax_depth = 3\nloss = {{ type = "Huber", delta = 0.1 }}\n[[parameters]]\nkey = "{KEY}"
initial = [0.5, 0.4, 0.3]\nbounds = [0.0, 1.0]\nlearning_rate = 0.01\nparameterisation = "log"\ntruth = 0.2
[[views]]\nreference = "photo.npy"\nweight = 1.0\nmask = "mask.npy"\nsensor = 0\n"""
    (place / "problem.toml").write_text(text)
    (place / "mesh.obj").write_bytes(_obj())
    np.save(place / "mask.npy", np.ones((4, 6), np.float32))
    return {path.name: path.read_bytes() for path in place.iterdir()}


def _obj() -> bytes:
    return b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvn 0 0 1\nf 1/1/1 2/2/1 3/1/1\nf 2//1 4//1 3//1\n"


@functools.cache
def _mesh_files() -> Files:
    return {
        "a.obj": _obj(),
        "text.ply": ply(((3, 0, 1, 2),), form="ascii"),
        "binary.ply": ply(((3, 0, 1, 2),)),
        "a.serialized": serialized(),
    }


@functools.cache
def _picture_files() -> Files:
    import cv2
    from PIL import Image

    pixels = np.random.default_rng(0).integers(0, 256, (12, 10, 3), np.uint8)
    found: Files = {"a.pfm": b"PF\n10 12\n-1.0\n" + bytes(1440), "a.npy": _npy(pixels)}
    forms: dict[str, dict[str, Any]] = {
        "a.png": {}, "a.jpg": {}, "b.jpg": {"format": "JPEG", "progressive": True}, "a.webp": {}, "b.webp": {"lossless": True},
        "a.bmp": {}, "a.tga": {}, "b.tga": {"compression": "tga_rle"}, "a.ppm": {}, "a.tif": {}, "b.tif": {"compression": "tiff_lzw"},
        "c.tif": {"compression": "tiff_adobe_deflate"}, "d.tif": {"compression": "packbits"}, "e.tif": {"compression": "jpeg"},
    }  # fmt: skip
    for name, options in forms.items():
        buffer = io.BytesIO()
        form = {".jpg": "JPEG", ".tif": "TIFF", ".ppm": "PPM"}.get(name[1:], name[2:].upper())
        Image.fromarray(pixels).save(buffer, **{"format": form, **options})
        found[name] = buffer.getvalue()
    for name, values in (("d.png", pixels.astype(np.uint16) * 257), ("f.tif", pixels.astype(np.uint16) * 257)):
        found[name] = cv2.imencode(name[1:], values)[1].tobytes()
    found["a.hdr"] = cv2.imencode(".hdr", pixels.astype(np.float32) / 255)[1].tobytes()
    place = Path(tempfile.mkdtemp(prefix="fuzz"))
    import mitsuba as mi

    with variant.two_threads(place / "a.exr"):
        mi.Bitmap(pixels.astype(np.float32)).write(str(place / "a.exr"))
    return found | {"a.exr": (place / "a.exr").read_bytes()}


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


@functools.cache
def _volume_files() -> Files:
    place = Path(tempfile.mkdtemp(prefix="fuzz"))
    values = np.random.default_rng(0).random((3, 4, 5, 1)).astype(np.float32)
    ur.io.write_grid(place / "a.vol", values)
    np.save(place / "a.npy", values)
    np.savez_compressed(place / "a.npz", values=values)
    return {path.name: path.read_bytes() for path in place.iterdir()}


@functools.cache
def _capture_files() -> Files:
    pose = np.eye(4).tolist()
    frames = [{"file_path": f"images/{name}.png", "transform_matrix": pose} for name in "ab"]
    head = {"fl_x": 10.0, "fl_y": 10.0, "cx": 5.0, "cy": 6.0, "w": 10, "h": 12, "k1": 0.01, "frames": frames}
    row = np.r_[np.column_stack([np.eye(3), np.zeros(3), [12, 10, 10]]).ravel(), 1, 9]
    return {
        "transforms/transforms.json": json.dumps(head).encode(),
        "text/cameras.txt": b"# a comment\n1 OPENCV 10 12 10 10 5 6 0.01 0 0 0\n",
        "text/images.txt": b"1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 1 1 b.png\n1 2 -1\n",
        "llff/poses_bounds.npy": _npy(np.array([row, row])),
        "lights/lights.txt": b"4\n0.3 0 1\n-0.3 0 1\n0 0.3 1\n0 -0.3 1\n",
    }


@functools.cache
def _colmap_files() -> Files:
    images = struct.pack("<Q", 2) + b"".join(
        struct.pack("<i7di", index, 1, 0, 0, 0, 0, 0, 0, 1) + f"{name}.png".encode() + b"\0" + struct.pack("<Q2dq", 1, 1, 1, 0)
        for index, name in enumerate("ab")
    )  # fmt: skip
    pinhole = struct.pack("<QiiQQ4d", 1, 1, 1, 10, 12, 10, 10, 5, 6)
    opencv = struct.pack("<QiiQQ8d", 1, 1, 4, 10, 12, 10, 10, 5, 6, 0.01, 0, 0, 0)
    found: Files = {}
    for place, cameras in (("binary/sparse/0", pinhole), ("distorted", opencv)):
        found |= {f"{place}/cameras.bin": cameras, f"{place}/images.bin": images}
    return found


@functools.cache
def _run_files() -> Files:
    folder = Path(tempfile.mkdtemp(prefix="fuzz")) / "run"
    problem = ur.gallery.problem("exponential")
    ur.optimize(problem, ur.PathGradient(spp=2), ur.optimizers.Adam(), steps=4, run_directory=folder)
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**record, "status": "interrupted"}, indent=1))
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _exportable_files() -> Files:
    """A problem whose mesh has texture coordinates throughout."""
    return _problem_files() | {"mesh.obj": _obj().rpartition(b"f ")[0]}


@functools.cache
def _result_files() -> Files:
    """A problem with a mesh, held-out views and the folder of a run."""
    place = Path(tempfile.mkdtemp(prefix="fuzz"))
    for name, data in _exportable_files().items():
        (place / name).write_bytes(data)
    problem = ur.Problem.from_file(place / "problem.toml")
    ur.optimize(problem, ur.PathGradient(spp=1), ur.optimizers.Adam(), steps=2, run_directory=place / "run")
    return {f"run/{path.name}": path.read_bytes() for path in (place / "run").iterdir() if path.is_file()}


# ---------------------------------------------------------------------- what is done with them


def _use_mesh(folder: Path, name: str) -> Any:
    kind = name.rpartition(".")[2]
    write_scene(folder, scene(body=f'<shape type="{kind}"><string name="filename" value="{name}"/></shape>'))
    return ur.Problem(folder / "scene.xml", [ur.Parameter(KEY)], [ur.View(folder / "photo.npy")])


def _use_picture(folder: Path, name: str) -> Any:
    path = folder / name
    results = [
        _refused(lambda read=read: read(path)) for read in (images.read, pictures.read, pictures.read_mask, _upright)
    ]
    if all(results):
        raise InputError(results[0])


def _upright(path: Path) -> Any:
    return pictures.upright(path, None)


def _refused(call: Callable[[], Any]) -> str:
    try:
        call()
    except InputError as error:
        return str(error)
    return ""


def _use_volume(folder: Path, name: str) -> Any:
    if name.endswith(".vol"):
        write_scene(folder, scene(body=_GRID))
        results = [_refused(lambda: volumes.read_grid(folder / name))]
        results += [
            _refused(lambda: ur.Problem(folder / "scene.xml", [ur.Parameter(KEY)], [ur.View(folder / "photo.npy")]))
        ]
        if all(results):
            raise InputError(results[0])
        return None
    return bounded_files.read_arrays(folder / name) if name.endswith("z") else bounded_files.read_array(folder / name)


_GRID = """<shape type="cube"><bsdf type="null"/><medium name="interior" type="heterogeneous"><volume type="gridvolume" name="sigma_t">
<string name="filename" value="a.vol"/></volume></medium></shape>"""


def _use_capture(folder: Path, name: str) -> Any:
    place = folder / name.partition("/")[0]
    lit = place.name == "lights"
    for picture in "abcd" if lit else "ab":
        target = (place if lit else place / "images") / f"{picture}.png"
        target.parent.mkdir(exist_ok=True)
        shutil.copy(folder / "photo.png", target)
    if lit:
        return lights.read(place)
    capture = formats.read(place)
    for photograph in capture.photographs:
        pictures.upright(photograph.file, photograph.lens)
    return capture


def _use_run(folder: Path, name: str) -> Any:
    """Take up the run, or show it."""
    del name
    results = [
        _refused(lambda: reader.read(folder)),
        _refused(lambda: report.page(folder)),
        _refused(lambda: ur.resume(folder, steps=6)),
    ]
    if all(results):
        raise InputError(results[0])


def _use_result(folder: Path, name: str) -> Any:
    """Judge it, turn it, export it."""
    del name
    run, views = folder / "run", folder / "held-out.toml"
    for file, data in _exportable_files().items():
        (folder / file).write_bytes(data)
    shutil.copy(folder / "problem.toml", views)
    results = [
        _refused(lambda: judge(run, views, spp=1, out=folder / "judge")),
        _refused(lambda: turntable(run, folder / "frames", frames=1, size=16, spp=1)),
        _refused(lambda: export(run, folder / "export")),
    ]
    if all(results):
        raise InputError(results[0])


def _use_problem(folder: Path, name: str) -> Any:
    del name
    return ur.Problem.from_file(folder / "problem.toml")


TARGETS: dict[str, tuple[Callable[[], Files], Use]] = {
    "problem": (_problem_files, _use_problem),
    "mesh": (_mesh_files, _use_mesh),
    "picture": (_picture_files, _use_picture),
    "volume": (_volume_files, _use_volume),
    "capture": (_capture_files, _use_capture),
    "colmap": (_colmap_files, _use_capture),
    "run": (_run_files, _use_run),
    "result": (_result_files, _use_result),
}


class _Inputs(Mapping[str, Hostile]):
    """Inputs by name, without end."""

    def __getitem__(self, name: str) -> Hostile:
        target, _, seed = name.partition(" ")
        files, use = TARGETS[target]

        def write(folder: Path) -> Callable[[], Any]:
            draw = random.Random(f"{target} {seed}")
            given = files()
            which = draw.choice(sorted(given))
            for file, data in given.items():
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (folder / file).write_bytes(damaged(file, data, draw) if file == which else data)
            if use is _use_capture:
                (folder / "photo.png").write_bytes(_picture_files()["a.png"])
            return lambda: use(folder, which)

        return write

    def __iter__(self) -> Iterator[str]:
        return iter(TARGETS)

    def __len__(self) -> int:
        return len(TARGETS)


INPUTS = _Inputs()


def names(first: int, count: int, targets: Sequence[str] = ()) -> list[str]:
    """Return the names of `count` inputs of each target; of all targets where none is named."""
    return [f"{target} {seed}" for seed in range(first, first + count) for target in targets or TARGETS]


def warm_up(place: Path, names: Sequence[str]) -> None:
    """Take in the sound files of these inputs, once: what is loaded then is no input's doing. Raises where one is refused."""
    for target in dict.fromkeys(name.partition(" ")[0] for name in names):
        files, use = TARGETS[target]
        for index, name in enumerate(files()):
            folder = place / f"{target}-{index}"
            for file, data in files().items():
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (folder / file).write_bytes(data)
            if use is _use_capture:
                (folder / "photo.png").write_bytes(_picture_files()["a.png"])
            use(folder, name)


def faults(outcomes: list[Outcome]) -> list[str]:
    """A line for each outcome that is none of a sound reader."""
    return [
        f"{o.name}: {o.kind}, {o.bytes >> 20} MB, {o.wall:.1f} s ({o.seconds:.1f} s of the processor): {o.said[:300]}"
        for o in outcomes
        if o.kind not in ("refused", "taken")
        or o.bytes > LARGEST
        or o.seconds > SLOWEST
        or not o.said.isprintable()
        or "\n" in o.said
    ]


class Tally:
    """Counts of the outcomes of one target, its processor seconds, and its largest input in memory and in time."""

    def __init__(self) -> None:
        self.kinds, self.faults = Counter[str](), 0
        self.seconds = self.slowest = 0.0
        self.largest = 0

    def add(self, outcome: Outcome) -> None:
        self.kinds[outcome.kind] += 1
        self.faults += len(faults([outcome]))
        self.seconds += outcome.seconds
        self.slowest = max(self.slowest, outcome.seconds)
        self.largest = max(self.largest, outcome.bytes)

    def __str__(self) -> str:
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(self.kinds.items()))
        return (
            f"{sum(self.kinds.values())} inputs in {self.seconds:.0f} processor seconds ({kinds}), at most "
            f"{self.largest >> 20} MB and {self.slowest:.1f} s; {self.faults} faults"
        )


def _main() -> int:
    options = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    options.add_argument("--seconds", type=float, default=60.0)
    options.add_argument("--first", type=int, default=0, help="seed of the first input")
    options.add_argument("--targets", nargs="+", default=list(TARGETS), choices=TARGETS, help="kinds of inputs")
    given = options.parse_args()
    end, first, count = time.monotonic() + given.seconds, given.first, _FEWEST
    found: list[str] = []
    tallies = {target: Tally() for target in given.targets}

    def note(outcome: Outcome) -> None:
        tallies[outcome.name.partition(" ")[0]].add(outcome)
        for line in faults([outcome]):
            print(line, flush=True)
            found.append(line)

    while (began := time.monotonic()) < end:
        with tempfile.TemporaryDirectory(prefix="fuzz") as place:
            take_in(Path(__file__).stem, "INPUTS", names(first, count, given.targets), Path(place), LONGEST, note)
        first += count
        for target, tally in tallies.items():
            print(f"# {target}: {tally}; seeds {given.first} to {first - 1}", flush=True)
        rate = count / (time.monotonic() - began)
        count = max(int(rate * min(_REPORT, end - time.monotonic())), _FEWEST)
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(_main())
