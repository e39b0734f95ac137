"""EMVA 1288 reference data: dark and flat images with a descriptor file.

A descriptor is a text file of one-letter lines: `v` release, `n` bits width height, then for each measurement
`b` exposure-in-ns photons-per-pixel (bright) or `d` exposure-in-ns (dark), followed by one `i` line per image. Paths
are relative, often with backslashes; decimals may be commas; `#` begins a comment.
"""

import math
import shutil
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath

import msgspec
import numpy as np

from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.files import check_free, sha256, write_json, write_whole, writing_folder
from faintfield.pipelines.formats.frames import RAW_SUFFIXES, Frame, read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.reading import is_file, read_text
from faintfield.pipelines.formats.results.noise import NoiseFrame
from faintfield.pipelines.formats.sets.noise_set import FILE_NAME as NOISE_SET_FILE
from faintfield.pipelines.formats.sets.noise_set import NoiseSet, load_noise_set
from faintfield.pipelines.formats.toml_files import inside, write_toml
from faintfield.pipelines.formats.units import MAX_EXPOSURE_S

DESCRIPTOR = "descriptor.txt"

_NS_PER_S = 1e9

# The release whose descriptors are written.
_RELEASE = "4.0"


class ImportedFrames(msgspec.Struct, frozen=True):
    """The result of `faintfield import emva1288`."""

    out: str
    frames: int
    release: str
    saturation_dn: float


class ExportedData(msgspec.Struct, frozen=True):
    """The result of `faintfield export emva1288`."""

    out: str
    frames: int
    bits: int
    size_px: tuple[int, int]


@dataclass
class Descriptor:
    """A descriptor file: release of the standard, bits per pixel, and the frames with the paths that it states."""

    release: str = ""
    bits: int = 0
    frames: list[NoiseFrame] = field(default_factory=list)


def import_data(descriptor: Path, out: Path, *, overwrite: bool = False) -> ImportedFrames:
    """Make a noise set of the images that a descriptor names."""
    check_free(out, replace_if=NOISE_SET_FILE, overwrite=overwrite)
    read = read_descriptor(descriptor)
    sources = [
        inside(descriptor.parent, PureWindowsPath(frame.file).as_posix(), f"{descriptor}: image")
        for frame in read.frames
    ]
    missing = next((source for source in sources if not is_file(source)), None)
    if missing is not None:
        raise MissingFile(f"{missing}: is named by {descriptor} but missing; unpack all of the data set")
    names = [f"frames/{index:05d}_{source.name}" for index, source in enumerate(sources)]
    frames = [msgspec.structs.replace(frame, file=name) for name, frame in zip(names, read.frames, strict=True)]
    saturation_dn = float(2**read.bits - 1)
    reads = [descriptor, *sources]
    with writing_folder(out, replace_if=NOISE_SET_FILE, overwrite=overwrite, reads=reads) as folder:
        (folder / "frames").mkdir()
        for source, name in progress(list(zip(sources, names, strict=True)), "copying frames"):
            shutil.copyfile(source, folder / name)
        write_toml(folder / NOISE_SET_FILE, NoiseSet(1, frames, saturation_dn))
        inputs = {frame.file: sha256(source) for frame, source in zip(read.frames, sources, strict=True)}
        inputs |= {descriptor.name: sha256(descriptor)}
        write_json(folder / "provenance.json", provenance("import emva1288", {}, inputs))
    inform(f"{out / NOISE_SET_FILE}: {len(frames)} frames of EMVA 1288 release {read.release or 'unstated'} data")
    return ImportedFrames(str(out), len(frames), read.release, saturation_dn)


def export_data(folder: Path, out: Path, *, overwrite: bool = False) -> ExportedData:
    """Write the frames of a noise set or a session as images and a descriptor: flats by their level, then darks.

    Raises
    ------
    MissingFile, BadValue
        There is no such folder, or a flat states no photons.
    """
    check_free(out, replace_if=DESCRIPTOR, overwrite=overwrite)
    if not folder.exists():
        raise MissingFile(f"{folder}: no such folder; name a noise set or a session")
    noise_set = load_noise_set(folder)
    settings = noise_set.settings
    for conditions, paths in noise_set.series.items():
        if conditions.kind == "flat" and not conditions.photons:
            raise BadValue(
                f"{paths[0]}: states no photons, which an EMVA 1288 descriptor gives for every bright image; add "
                "photons to its entry, or leave it out"
            )
    order = sorted(noise_set.series, key=lambda series: (series.kind != "flat", series.level, series.exposure_s))
    sources = [(path, conditions) for conditions in order for path in noise_set.series[conditions]]
    first = read_frame(sources[0][0])
    if first.pixels_dn.ndim != 2:
        raise BadValue(
            f"{sources[0][0]}: is a colour picture, and EMVA 1288 data have one channel; give raw or grey frames"
        )
    bits = _bits(settings, first)
    region = (slice(*settings.region.rows), slice(*settings.region.columns)) if settings.region else np.s_[:, :]
    height, width = first.pixels_dn[region].shape
    lines = [f"v {_RELEASE}", f"n {bits} {width} {height}"]
    reads = [noise_set.folder, *(path for path, _ in sources)]
    with writing_folder(out, replace_if=DESCRIPTOR, overwrite=overwrite, reads=reads) as building:
        (building / "images").mkdir()
        last = None
        for index, (source, conditions) in enumerate(progress(sources, "writing images")):
            if conditions != last:
                exposure_ns = repr(conditions.exposure_s * _NS_PER_S)
                dark = conditions.kind == "dark"
                lines.append(f"d {exposure_ns}" if dark else f"b {exposure_ns} {conditions.photons!r}")
                last = conditions
            # Regions and raw files are written anew
            whole = settings.region is None and source.suffix.lower() not in RAW_SUFFIXES
            name = f"images/{index:05d}_{source.stem}{source.suffix if whole else '.tiff'}"
            pixels = read_frame(source, first.pixels_dn.shape[1::-1], of="the first frame").pixels_dn
            if whole:
                shutil.copyfile(source, building / name)
            else:
                write_frame(building / name, pixels[region])
            lines.append("i " + str(PureWindowsPath(name)))
        write_whole(building / DESCRIPTOR, "\n".join(lines) + "\n")
    inform(f"{out / DESCRIPTOR}: {len(sources)} images of {bits} bits, {width} x {height} px")
    return ExportedData(str(out), len(sources), bits, (width, height))


def read_descriptor(path: Path) -> Descriptor:
    """Read a descriptor file.

    Raises
    ------
    MissingFile
        There is no such file.
    BadValue
        A line is not of the format; the message gives its number.
    """
    if not is_file(path):
        raise MissingFile(f"{path}: no such file; name an EMVA 1288 descriptor file")
    read = Descriptor()
    current: NoiseFrame | None = None
    levels: dict[float, int] = {}
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split(maxsplit=1)
        if not words or words[0].startswith("#"):
            continue
        try:
            match words:
                case ["b" | "d" as keyword, rest]:
                    current = _measurement(keyword, rest, levels)
                case ["v", rest]:
                    read.release = rest.strip()
                case ["n", rest]:
                    read.bits = int(rest.split()[0])
                case ["i", rest] if current is not None:
                    read.frames.append(msgspec.structs.replace(current, file=rest.strip()))
                case ["i", _]:
                    raise ValueError("an image before any 'b' or 'd' line")
                case ["v" | "n" | "b" | "d" | "i"]:
                    raise ValueError("no value follows it")
                case [keyword, *_]:
                    raise ValueError(f"'{keyword}' is none of v, n, b, d, i")
        except ValueError as failure:
            raise BadValue(
                f"{path}: line {number}: '{line.strip():.80}' cannot be read ({failure}); correct it"
            ) from failure
    if not read.frames or not 1 <= read.bits <= 32:
        raise BadValue(
            f"{path}: names {len(read.frames)} images of {read.bits} bits; an 'n' line and images are needed; "
            "name the descriptor of a data set"
        )
    return read


def _measurement(keyword: str, rest: str, levels: dict[float, int]) -> NoiseFrame:
    """Return the frame of a `b` or `d` line, without its file; equal photons are one light level."""
    numbers = [float(word.replace(",", ".")) for word in rest.split()]
    if len(numbers) != (2 if keyword == "b" else 1):
        raise ValueError("give 'b exposure photons' or 'd exposure'")
    if not all(0 <= number < math.inf for number in numbers):
        raise ValueError("exposures and photons are finite and not negative")
    exposure_s = numbers[0] / _NS_PER_S
    if exposure_s > MAX_EXPOSURE_S:
        raise ValueError(f"an exposure of {exposure_s:g} s is longer than {MAX_EXPOSURE_S:g} s")
    if keyword == "d" or numbers[1] == 0:
        return NoiseFrame("", "dark", exposure_s)
    level = levels.setdefault(numbers[1], len(levels))
    return NoiseFrame("", "flat", exposure_s, None, level, numbers[1])


def _bits(settings: NoiseSet, first: Frame) -> int:
    """Return the bits per pixel; the format takes saturation for the last value of these."""
    end_dn = settings.saturation_dn or first.saturation_dn or float(np.iinfo(first.pixels_dn.dtype).max)
    bits = int(np.ceil(np.log2(end_dn + 1)))
    if end_dn != 2**bits - 1:
        inform(f"saturation at {end_dn:g} DN cannot be stated; readers will take {2**bits - 1} DN, of {bits} bits")
    return bits
