"""`faintfield import mrcal` and `faintfield export mrcal`: lens and poses from and to .cameramodel files."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from calib.lens import Lens
from pipelines.arguments import Positive
from pipelines.elemental_set import load_set
from pipelines.errors import BadValue, MissingFile
from pipelines.files import building_folder, write_whole
from pipelines.frames import IMAGE_SUFFIXES
from pipelines.geometry_files import camera_model_text
from pipelines.posed_images import PosedImage, write_posed_set

_SUFFIX = ".cameramodel"
_MODELS = {"LENSMODEL_PINHOLE", "LENSMODEL_OPENCV4", "LENSMODEL_OPENCV5", "LENSMODEL_OPENCV8"}
_LENS_MODEL = {0: "pinhole", 4: "opencv4", 5: "opencv5", 8: "opencv8"}


def import_mrcal(
    src: Path,
    out: Path,
    /,
    *,
    images: Path | None = None,
    mm_per_unit: Positive = 1000.0,
    reference: str | None = None,
    exposure_s: Positive | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Make an elemental set from a folder of .cameramodel files and images of the same names.

    Parameters
    ----------
    src
        Folder of .cameramodel files, one per image, all with the same lens.
    out
        Folder to write.
    images
        Folder of the images; SRC by default.
    mm_per_unit
        Length of the models' unit; mrcal's is the metre.
    reference
        Name of the image whose camera is the reference; the one nearest to the middle by default.
    exposure_s
        Of each image; from EXIF by default, 1 s where there is none.
    overwrite
        Replace an earlier set in OUT.
    """
    paths = sorted(src.glob(f"*{_SUFFIX}"))
    if not paths:
        raise MissingFile(f"{src}: holds no {_SUFFIX} files; name the folder that holds one per image")
    scale = np.repeat([1.0, mm_per_unit], 3)
    lenses, posed = [], []
    for path in paths:
        lens, rt_cam_world = _read(path)
        lenses.append(lens)
        posed.append(PosedImage(_image_of(path, images or src), rt_cam_world * scale))
    if len(set(lenses)) > 1:
        raise BadValue(
            f"{src}: its models have {len(set(lenses))} different lenses; one camera on a gantry is one lens; "
            "name the folder of one calibration"
        )
    name = write_posed_set(
        out,
        lenses[0],
        posed,
        reference=reference,
        exposure_s=exposure_s,
        command="import mrcal",
        options={"mm_per_unit": mm_per_unit, "reference": reference},
        overwrite=overwrite,
    )
    return {"out": str(out), "views": len(posed), "reference": name}


def export_mrcal(
    elemental_set: Annotated[Path, Parameter(name="SET")], out: Path, /, *, overwrite: bool = False
) -> dict[str, Any]:
    """Write the lens and poses of an elemental set as .cameramodel files, one per view, in metres.

    Parameters
    ----------
    elemental_set
        Folder with elemental.toml.
    out
        Folder to write.
    overwrite
        Replace earlier models in OUT.
    """
    loaded = load_set(elemental_set)
    count = next(count for count in _LENS_MODEL if count >= len(loaded.lens.distortion))
    lens = loaded.lens
    padded = (*lens.distortion, *[0.0] * (count - len(lens.distortion)))
    lens = Lens(lens.size_px, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, padded)
    names = [Path(view.image).with_suffix(_SUFFIX).name for view in loaded.settings.view]
    with building_folder(out, replace_if=names[0] if overwrite else None) as folder:
        for name, pose in zip(names, loaded.poses_rt_cam_ref, strict=True):
            write_whole(folder / name, camera_model_text(lens, _LENS_MODEL[count], pose))
    return {"out": str(out), "views": len(names)}


def _read(path: Path) -> tuple[Lens, Any]:
    """Return the lens and the pose of a camera model."""
    import mrcal  # loading it takes a while

    try:
        model = mrcal.cameramodel(str(path))
        name, numbers = model.intrinsics()
        width, height = (int(side) for side in model.imagersize())
    except Exception as failure:  # mrcal raises what it likes
        raise BadValue(
            f"{path}: is not a camera model that can be read ({failure}); write it with mrcal again".replace("\n", " ")
        ) from failure
    if name not in _MODELS:
        raise BadValue(
            f"{path}: its lens is {name}; convert it with mrcal-convert-lensmodel to one of {sorted(_MODELS)}"
        )
    fx_px, fy_px, cx_px, cy_px, *distortion = (float(number) for number in numbers)
    return Lens((width, height), fx_px, fy_px, cx_px, cy_px, tuple(distortion)), np.array(model.rt_cam_ref())


def _image_of(path: Path, folder: Path) -> Path:
    """Return the image of a camera model's name."""
    for suffix in sorted(IMAGE_SUFFIXES):
        image = folder / f"{path.stem}{suffix}"
        if image.is_file():
            return image
    raise MissingFile(f"{folder}: holds no image named {path.stem}; put it there, or name its folder with --images")
