"""`faintfield import colmap` and `faintfield export colmap`: lens and poses from and to COLMAP's sparse models."""

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from faintfield.pipelines.arguments import Positive
from faintfield.pipelines.formats.exchange.colmap import (
    MODEL_FILES,
    ColmapImage,
    ColmapModel,
    model_files,
    read_model,
    write_model,
)
from faintfield.pipelines.formats.exchange.imported_set import PosedImage
from faintfield.pipelines.formats.exchange.posed_images import import_posed, lens_of_each_view
from faintfield.pipelines.formats.files import writing_folder
from faintfield.pipelines.formats.sets.session_set import load_set_or_session


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
) -> dict[str, Any]:
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
        Of each image; from EXIF by default, 1 s where there is none.
    overwrite
        Replace an earlier set in OUT.
    """
    model = read_model(src)
    return import_posed(
        out,
        model_files(src),
        [
            PosedImage((images or src) / image.name, model.lenses[image.camera], image.rt_cam_world)
            for image in model.images
        ],
        mm_per_unit=mm_per_unit,
        reference=reference,
        exposure_s=exposure_s,
        command="import colmap",
        overwrite=overwrite,
    )


def export_colmap(
    elemental_set: Annotated[Path, Parameter(name="SESSION|SET")],
    out: Path,
    /,
    *,
    binary: bool = False,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write the lens and poses of an elemental set as a COLMAP model without points; its unit is the mm.

    Views with principal points of their own get cameras of their own.

    Parameters
    ----------
    elemental_set
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder to write.
    binary
        .bin instead of .txt files.
    overwrite
        Replace an earlier model in OUT, a folder that holds nothing else.
    """
    loaded = load_set_or_session(elemental_set)
    lenses = lens_of_each_view(loaded)
    cameras = {lens: number for number, lens in enumerate(dict.fromkeys(lenses), start=1)}
    model = ColmapModel(
        {number: lens for lens, number in cameras.items()},
        [
            ColmapImage(view.image, cameras[lens], pose)
            for view, lens, pose in zip(loaded.settings.view, lenses, loaded.poses_rt_cam_ref, strict=True)
        ],
    )
    with writing_folder(out, replace_only=MODEL_FILES if overwrite else ()) as folder:
        write_model(folder, model, binary=binary)
    return {"out": str(out), "views": len(model.images)}
