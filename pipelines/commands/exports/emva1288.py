"""`faintfield export emva1288`: dark and flat frames as the data of the EMVA 1288 standard."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
from cyclopts import Parameter

from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import BadValue, MissingFile

if TYPE_CHECKING:
    from faintfield.calib.noise import Conditions
    from faintfield.pipelines.formats.frames import Frame
    from faintfield.pipelines.formats.sets.noise_set import NoiseSet


class ExportedData(msgspec.Struct, frozen=True):
    """The result of `faintfield export emva1288`."""

    out: str
    frames: int
    bits: int
    size_px: tuple[int, int]


def export_emva1288(
    folder: Annotated[Path, Parameter(name="DIR")], out: Path, /, *, overwrite: bool = False
) -> ExportedData:
    """Write dark and flat frames as EMVA 1288 data: a descriptor file and the images that it names.

    The flats must state their photons. Raw files and frames of which only a region is used become TIFF; other images
    are copied as they are. The format has no temperatures and no colour filters.

    Parameters
    ----------
    folder
        A session with dark frames, or a folder with noise.toml and the frames that it names.
    out
        Folder to write: descriptor.txt and images.
    overwrite
        Replace earlier data in OUT.
    """
    from faintfield.pipelines.formats.exchange.emva1288 import DESCRIPTOR, descriptor_text
    from faintfield.pipelines.formats.files import write_whole, writing_folder
    from faintfield.pipelines.formats.frames import read_frame
    from faintfield.pipelines.formats.sets.noise_set import load_noise_set

    if not folder.exists():
        raise MissingFile(f"{folder}: no such folder; name a noise set or a session")
    folder, settings = load_noise_set(folder)
    series = _ordered(folder, settings)
    first = read_frame(series[0][1][0])
    bits = _bits(settings, first)
    sources = [path for _, paths in series for path in paths]
    replace = DESCRIPTOR if overwrite else None
    with writing_folder(out, replace_if=replace, reads=[folder, *sources]) as building:
        (building / "images").mkdir()
        names = {}
        for index, source in enumerate(progress(sources, "writing images")):
            names[source] = _write_image(source, building, index, settings, first)
        images = [(conditions, [names[path] for path in paths]) for conditions, paths in series]
        height, width = first.pixels_dn[_region(settings)].shape
        write_whole(building / DESCRIPTOR, descriptor_text(images, bits, (width, height)))
    inform(f"{out / DESCRIPTOR}: {len(sources)} images of {bits} bits, {width} x {height} px")
    return ExportedData(str(out), len(sources), bits, (width, height))


def _ordered(folder: Path, settings: "NoiseSet") -> "list[tuple[Conditions, list[Path]]]":
    """Return the series with their frames, flats by their level and then darks, as the standard's data have them."""
    from faintfield.pipelines.formats.sets.noise_set import group_frames

    series = list(group_frames(folder, settings).items())
    for conditions, paths in series:
        if conditions.kind == "flat" and not conditions.photons:
            raise BadValue(
                f"{paths[0]}: states no photons, which an EMVA 1288 descriptor gives for every bright image; add "
                "photons to its entry, or leave it out"
            )
    return sorted(series, key=lambda item: (item[0].kind != "flat", item[0].level, item[0].exposure_s))


def _bits(settings: "NoiseSet", first: "Frame") -> int:
    """Return the bits per pixel; the format takes saturation for the last value of these."""
    import numpy as np

    end_dn = settings.saturation_dn or first.saturation_dn or float(np.iinfo(first.pixels_dn.dtype).max)
    bits = int(np.ceil(np.log2(end_dn + 1)))
    if end_dn != 2**bits - 1:
        inform(f"saturation at {end_dn:g} DN cannot be stated; readers will take {2**bits - 1} DN, of {bits} bits")
    return bits


def _region(settings: "NoiseSet") -> tuple[slice, slice]:
    """Return the rows and columns in use."""
    region = settings.region
    return (slice(*region.rows), slice(*region.columns)) if region else (slice(None), slice(None))


def _write_image(source: Path, folder: Path, index: int, settings: "NoiseSet", first: "Frame") -> str:
    """Write one image, and return its path within the folder."""
    from faintfield.pipelines.formats.frames import RAW_SUFFIXES, read_frame
    from faintfield.pipelines.formats.image_files import write_frame

    height, width = first.pixels_dn.shape[:2]
    pixels = read_frame(source, (width, height), of="the first frame").pixels_dn
    as_it_is = settings.region is None and source.suffix.lower() not in RAW_SUFFIXES
    name = f"images/{index:05d}_{source.stem}{source.suffix if as_it_is else '.tiff'}"
    if as_it_is:
        shutil.copyfile(source, folder / name)
    else:
        write_frame(folder / name, pixels[_region(settings)])
    return name
