"""`faintfield import mrcal`: lens and poses from .cameramodel files."""

from pathlib import Path
from typing import TYPE_CHECKING

from faintfield.pipelines.arguments import Positive

if TYPE_CHECKING:
    from faintfield.pipelines.formats.exchange.imported_set import ImportedSet


type Result = ImportedSet


def import_mrcal(
    src: Path,
    out: Path,
    /,
    *,
    images: Path | None = None,
    mm_per_unit: Positive = 1000.0,
    reference: str | None = None,
    exposure_s: Positive | None = None,
    linear: bool = False,
    srgb: bool = False,
    overwrite: bool = False,
) -> Result:
    """Make an elemental set from a folder of .cameramodel files and images of the same names.

    Parameters
    ----------
    src
        Folder of .cameramodel files, one per image, all with the same lens but for its principal point.
    out
        Folder to write.
    images
        Folder of the images; SRC by default.
    mm_per_unit
        Length of the models' unit; mrcal's is the metre.
    reference
        Name of the image whose camera is the reference; the one nearest to the middle by default.
    exposure_s
        Exposure of each image; by default that of EXIF; not known where there is none.
    linear
        Values of 8-bit images are proportional to light; without it the tone curve of sRGB is undone.
    srgb
        16-bit images have the tone curve of sRGB, too, which is undone.
    overwrite
        Replace an earlier set in OUT.
    """
    from faintfield.pipelines.formats.exchange.imported_set import import_posed
    from faintfield.pipelines.formats.exchange.mrcal import read_camera_models
    from faintfield.pipelines.formats.exchange.tone import asked_tone

    posed = read_camera_models(src, images or src)
    return import_posed(
        out,
        posed,
        mm_per_unit=mm_per_unit,
        reference=reference,
        exposure_s=exposure_s,
        tone=asked_tone(linear=linear, srgb=srgb),
        command="import mrcal",
        overwrite=overwrite,
    )
