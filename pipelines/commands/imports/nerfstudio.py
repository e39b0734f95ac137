"""`faintfield import nerfstudio`: lens and poses from a transforms.json."""

from pathlib import Path
from typing import TYPE_CHECKING

from faintfield.pipelines.arguments import Positive

if TYPE_CHECKING:
    from faintfield.pipelines.formats.exchange.imported_set import ImportedSet


type Result = ImportedSet


def import_nerfstudio(
    src: Path,
    out: Path,
    /,
    *,
    images: Path | None = None,
    mm_per_unit: Positive | None = None,
    reference: str | None = None,
    exposure_s: Positive | None = None,
    linear: bool = False,
    srgb: bool = False,
    overwrite: bool = False,
) -> Result:
    """Make an elemental set from the transforms.json of nerfstudio or instant-ngp and its images.

    Parameters
    ----------
    src
        The transforms.json, or the folder that holds it.
    out
        Folder to write.
    images
        Folder from which the names of images count; that of the transforms.json by default.
    mm_per_unit
        Length of the file's unit, if it is known: measure something. Without it depths are relative.
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
    from faintfield.pipelines.formats.exchange.nerfstudio import read_transforms
    from faintfield.pipelines.formats.exchange.tone import asked_tone

    return import_posed(
        out,
        read_transforms(src, images),
        mm_per_unit=mm_per_unit,
        reference=reference,
        exposure_s=exposure_s,
        tone=asked_tone(linear=linear, srgb=srgb),
        command="import nerfstudio",
        overwrite=overwrite,
    )
