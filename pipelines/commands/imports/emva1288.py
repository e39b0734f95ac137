"""`faintfield import emva1288`: the descriptor files of EMVA 1288 reference data become noise sets.

A descriptor is a text file of one-letter lines: `v` release, `n` bits width height, then for each measurement
`b` exposure-in-ns photons-per-pixel (bright) or `d` exposure-in-ns (dark), followed by one `i` line per image. Paths
are relative, often with backslashes; decimals may be commas; `#` begins a comment.
"""

import math
import shutil
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath
from typing import Any

from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.files import sha256, write_json, writing_folder
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.sets.noise_set import FILE_NAME, NoiseFrame, NoiseSet, write_noise_set

_NS_PER_S = 1e9


@dataclass
class Descriptor:
    """What a descriptor file says."""

    release: str = ""
    bits: int = 0
    frames: list[NoiseFrame] = field(default_factory=list)


def import_emva1288(descriptor: Path, out: Path, /) -> dict[str, Any]:
    """Make a noise set of EMVA 1288 reference data.

    Parameters
    ----------
    descriptor
        The data's descriptor file; images lie beside it.
    out
        Folder to write: noise.toml and copies of the images.
    """
    if not descriptor.is_file():
        raise MissingFile(f"{descriptor}: no such file; name an EMVA 1288 descriptor file")
    read = parse_descriptor(descriptor)
    sources = [_image_path(descriptor, frame.file) for frame in read.frames]
    names = [f"frames/{index:05d}_{source.name}" for index, source in enumerate(sources)]
    frames = [
        NoiseFrame(name, frame.kind, frame.exposure_s, None, frame.level, frame.photons)
        for name, frame in zip(names, read.frames, strict=True)
    ]
    saturation_dn = float(2**read.bits - 1)
    with writing_folder(out) as folder:
        (folder / "frames").mkdir()
        for source, name in progress(list(zip(sources, names, strict=True)), "copying frames"):
            shutil.copyfile(source, folder / name)
        write_noise_set(folder, NoiseSet(1, frames, saturation_dn))
        inputs = {frame.file: sha256(source) for frame, source in zip(read.frames, sources, strict=True)}
        inputs |= {descriptor.name: sha256(descriptor)}
        write_json(folder / "provenance.json", provenance("import emva1288", {}, inputs))
    inform(f"{out / FILE_NAME}: {len(frames)} frames of EMVA 1288 release {read.release or 'unstated'} data")
    return {"out": str(out), "frames": len(frames), "release": read.release, "saturation_dn": saturation_dn}


def parse_descriptor(path: Path) -> Descriptor:
    """Read a descriptor file; the frames keep the paths that it states.

    Raises
    ------
    BadValue
        A line is not of the format; the message gives its number.
    """
    read = Descriptor()
    current: NoiseFrame | None = None
    levels: dict[float, int] = {}
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        words = line.split(maxsplit=1)
        if not words or words[0].startswith("#"):
            continue
        try:
            keyword, rest = words
            if keyword == "i":
                if current is None:
                    raise ValueError("an image before any 'b' or 'd' line")
                read.frames.append(_with_file(current, rest.strip()))
            elif keyword in ("b", "d"):
                current = _measurement(keyword, rest, levels)
            elif keyword == "v":
                read.release = rest.strip()
            elif keyword == "n":
                read.bits = int(rest.split()[0])
            else:
                raise ValueError(f"'{keyword}' is none of v, n, b, d, i")
        except ValueError as failure:
            raise BadValue(
                f"{path}: line {number}: '{line.strip()}' cannot be read ({failure}); correct it"
            ) from failure
    if not read.frames or not 1 <= read.bits <= 32:
        raise BadValue(
            f"{path}: names {len(read.frames)} images of {read.bits} bits; an 'n' line and images are needed; "
            "name the descriptor of a data set"
        )
    return read


def _measurement(keyword: str, rest: str, levels: dict[float, int]) -> NoiseFrame:
    """Return what the images of a `b` or `d` line have in common; equal photons are one light level."""
    numbers = [float(word.replace(",", ".")) for word in rest.split()]
    if len(numbers) != (2 if keyword == "b" else 1):
        raise ValueError("give 'b exposure photons' or 'd exposure'")
    if not all(0 <= number < math.inf for number in numbers):
        raise ValueError("exposures and photons are finite and not negative")
    exposure_s = numbers[0] / _NS_PER_S
    if keyword == "d" or numbers[1] == 0:
        return NoiseFrame("", "dark", exposure_s)
    level = levels.setdefault(numbers[1], len(levels))
    return NoiseFrame("", "flat", exposure_s, None, level, numbers[1])


def _with_file(frame: NoiseFrame, file: str) -> NoiseFrame:
    """Return a frame with its file."""
    return NoiseFrame(file, frame.kind, frame.exposure_s, frame.temperature_c, frame.level, frame.photons)


def _image_path(descriptor: Path, stated: str) -> Path:
    """Return where an image lies, whichever slashes the descriptor uses."""
    path = descriptor.parent / PureWindowsPath(stated).as_posix()
    if not path.is_file():
        raise MissingFile(f"{path}: is named by {descriptor} but missing; unpack all of the data set")
    return path
