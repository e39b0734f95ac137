"""`faintfield import colmap`: lens and poses from COLMAP's sparse models."""

from pathlib import Path

from faintfield.pipelines.arguments import Positive
from faintfield.pipelines.formats.exchange.colmap import read_posed_images
from faintfield.pipelines.formats.exchange.imported_set import ImportedSet, import_posed


def import_colmap(
    src: Path,
    out: Path,
    /,
    *,
    images: Path | None = None,
    mm_per_unit: Positive = 1.0,
    reference: str | None = None,
    exposure_s: Positive | None = None,
    overwrite: bool = False,
) -> ImportedSet:
    """Make an elemental set from a COLMAP model, text or binary, and its images.

    Parameters
    ----------
    src
        Folder of the sparse model: cameras and images, .bin or .txt.
    out
        Folder to write.
    images
        Folder of the images; SRC by default.
    mm_per_unit
        Length of the model's unit, which COLMAP cannot know: measure something, or depths are in its unit.
    reference
        Name of the image whose camera is the reference; the one nearest to the middle by default.
    exposure_s
        Exposure of each image; by default that of EXIF, or 1 s where there is none.
    overwrite
        Replace an earlier set in OUT.
    """
    return import_posed(
        out,
        read_posed_images(src, images or src),
        mm_per_unit=mm_per_unit,
        reference=reference,
        exposure_s=exposure_s,
        command="import colmap",
        overwrite=overwrite,
    )
