"""Search for photographs and masks by the names in a format's files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from unrender.core.errors import InputError
from unrender.core.text import printable, shorten

PICTURES = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff", ".webp", ".tga", ".bmp", ".hdr", ".ppm", ".pfm")
"""File extensions of photographs."""
MOST = 10_000
"""Maximum number of photographs of a capture, since the search for files and masks of more takes hours."""
_WITHOUT_ENDING = (*PICTURES, ".PNG", ".JPG", ".JPEG", "_rgb.exr", "_rgba.png")
"""Extensions that are tried in order if a format names a photograph without its extension."""
_MASK_FOLDERS = ("masks", "mask")


def check_count(count: int, where: Path) -> None:
    """Raise `InputError` for more than `MOST` photographs."""
    if count > MOST:
        raise InputError(f"{where}: {count} photographs, expected at most {MOST}; use a subset, such as every tenth")


def is_file(path: Path) -> bool:
    """Return whether the file exists. A name that the system does not allow counts as absent."""
    try:
        return path.is_file()
    except OSError:
        return False


def pictures(folder: Path) -> list[Path]:
    """Return the pictures of a folder in the order of their names; none if the folder does not exist."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES and path.is_file())


def find_picture(folder: Path, name: str) -> Path | None:
    """Return the file of a photograph that a format calls `name`, relative to `folder`; None if it does not exist."""
    name = name.replace("\\", "/")
    for candidate in (folder / name, *(folder / f"{name}{ending}" for ending in _WITHOUT_ENDING)):
        if is_file(candidate):
            return candidate
    return None


def find_mask(folder: Path, photograph: Path, mask_folder: Path | None, named: str | None = None) -> Path | None:
    """Return the mask of a photograph, or None.

    Search order: only `mask_folder`, if it is set; the file that the format names; NAME_mask.png next to the photograph; a
    folder named after the photograph's, such as train_mask for train; masks or mask, in `folder` or next to the photograph's folder.
    There it has the photograph's name, with or without the original extension before its own. Longer relative paths of the photograph
    take precedence over its bare name.
    """
    relative = _relative(folder, photograph)
    if mask_folder is not None:
        mask = _of_name(mask_folder, relative)
        return None if mask == photograph else mask
    if named is not None:
        path = folder / named
        if not is_file(path):
            raise InputError(
                f"{shorten(str(path), 300)}: no such file, and {printable(photograph.name)} names it as its mask"
            )
        return path
    stem = photograph.stem.removesuffix("_rgb").removesuffix("_rgba")
    for ending in PICTURES:
        if is_file(candidate := photograph.with_name(f"{stem}_mask{ending}")):
            return candidate
    own = photograph.parent.with_name(f"{photograph.parent.name}_mask") if photograph.parent.name else folder / "mask"
    places = [own, *(place / name for place in (folder, photograph.parent.parent) for name in _MASK_FOLDERS)]
    return next((mask for place in places if (mask := _of_name(place, relative)) is not None), None)


def _relative(folder: Path, photograph: Path) -> list[Path]:
    """Return images/left/1.png, left/1.png and 1.png for a photograph images/left/1.png of `folder`."""
    parts = photograph.relative_to(folder).parts if photograph.is_relative_to(folder) else (photograph.name,)
    ends = [parts[index:] for index in range(len(parts))]
    return [Path(*end) for end in ends if ".." not in end]


def _of_name(folder: Path, relative: Iterable[Path]) -> Path | None:
    for path in relative:
        place = folder / path.parent
        if place.is_dir():
            names = (path.name, *(f"{path.stem}{e}" for e in PICTURES), *(f"{path.name}{e}" for e in PICTURES))
            if (file := next((place / name for name in names if is_file(place / name)), None)) is not None:
                return file
    return None


def notices(used: Sequence[Path], missing: Sequence[str], count: int) -> tuple[str, ...]:
    """Return notices on photographs with known poses but missing files, and on pictures next to the `used` ones without a pose."""
    known = {path.resolve() for path in used}
    rest = [
        path
        for folder in sorted({path.parent for path in used})
        for path in pictures(folder)
        if path.resolve() not in known and not path.stem.endswith("_mask")
    ]
    lines = []
    if missing:
        first = printable(missing[0])
        lines.append(f"{len(missing)} of {count} photographs are missing and were skipped, the first {first}")
    if rest:
        lines.append(f"{len(rest)} pictures have no pose and were skipped, the first {printable(rest[0].name)}")
    return tuple(lines)
