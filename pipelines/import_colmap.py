"""`faintfield import colmap` and `faintfield export colmap`: lens and poses from and to COLMAP's sparse models."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from pipelines.arguments import Positive
from pipelines.colmap_files import ColmapImage, ColmapModel, read_model, write_model
from pipelines.elemental_set import load_set
from pipelines.errors import BadValue
from pipelines.files import building_folder
from pipelines.posed_images import PosedImage, write_posed_set


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
    used = sorted({image.camera for image in model.images})
    if len(used) != 1:
        raise BadValue(
            f"{src}: its images were taken with {len(used)} cameras; one camera on a gantry is one lens; "
            "let COLMAP share one camera (ImageReader.single_camera)"
        )
    scale = np.repeat([1.0, mm_per_unit], 3)
    folder = images or src
    posed = [PosedImage(folder / image.name, image.rt_cam_world * scale) for image in model.images]
    name = write_posed_set(
        out,
        model.lenses[used[0]],
        posed,
        reference=reference,
        exposure_s=exposure_s,
        command="import colmap",
        options={"mm_per_unit": mm_per_unit, "reference": reference},
        overwrite=overwrite,
    )
    return {"out": str(out), "views": len(posed), "reference": name}


def export_colmap(
    elemental_set: Annotated[Path, Parameter(name="SET")],
    out: Path,
    /,
    *,
    binary: bool = False,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write the lens and poses of an elemental set as a COLMAP model without points; its unit is the mm.

    Parameters
    ----------
    elemental_set
        Folder with elemental.toml.
    out
        Folder to write.
    binary
        .bin instead of .txt files.
    overwrite
        Replace an earlier model in OUT.
    """
    loaded = load_set(elemental_set)
    poses = zip(loaded.settings.view, loaded.poses_rt_cam_ref, strict=True)
    model = ColmapModel({1: loaded.lens}, [ColmapImage(view.image, 1, pose) for view, pose in poses])
    known_by = f"cameras.{'bin' if binary else 'txt'}"
    with building_folder(out, replace_if=known_by if overwrite else None) as folder:
        write_model(folder, model, binary=binary)
    return {"out": str(out), "views": len(model.images)}
