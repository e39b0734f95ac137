"""`faintfield import mrcal` and `faintfield export mrcal`: lens and poses from and to .cameramodel files."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from faintfield.calib.lens import Lens
from faintfield.pipelines.arguments import Positive
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.exchange.imported_set import PosedImage
from faintfield.pipelines.formats.exchange.posed_images import import_posed, lens_of_each_view
from faintfield.pipelines.formats.files import write_whole, writing_folder
from faintfield.pipelines.formats.frames import IMAGE_SUFFIXES
from faintfield.pipelines.formats.results.geometry import camera_model_text
from faintfield.pipelines.formats.sets.session_set import load_set_or_session

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
        Of each image; from EXIF by default, 1 s where there is none.
    overwrite
        Replace an earlier set in OUT.
    """
    paths = sorted(src.glob(f"*{_SUFFIX}"))
    if not paths:
        raise MissingFile(f"{src}: holds no {_SUFFIX} files; name the folder that holds one per image")
    return import_posed(
        out,
        paths,
        [_read(path, images or src) for path in paths],
        mm_per_unit=mm_per_unit,
        reference=reference,
        exposure_s=exposure_s,
        command="import mrcal",
        overwrite=overwrite,
    )


def export_mrcal(
    elemental_set: Annotated[Path, Parameter(name="SESSION|SET")], out: Path, /, *, overwrite: bool = False
) -> dict[str, Any]:
    """Write the lens and poses of an elemental set as .cameramodel files, one per view, in metres.

    Parameters
    ----------
    elemental_set
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder to write.
    overwrite
        Replace earlier models in OUT, a folder that holds nothing else.
    """
    loaded = load_set_or_session(elemental_set)
    count = next(count for count in _LENS_MODEL if count >= len(loaded.lens.distortion))
    padded = (*loaded.lens.distortion, *[0.0] * (count - len(loaded.lens.distortion)))
    models: dict[str, str] = {}
    for view, lens, pose in zip(loaded.settings.view, lens_of_each_view(loaded), loaded.poses_rt_cam_ref, strict=True):
        name = Path(view.image).with_suffix(_SUFFIX).name
        if name in models:
            raise BadValue(f"{elemental_set}: {view.image} would become {name} like another view; rename its image")
        models[name] = camera_model_text(replace(lens, distortion=padded), _LENS_MODEL[count], pose)
    with writing_folder(out, replace_only=[f"*{_SUFFIX}"] if overwrite else ()) as folder:
        for name, text in models.items():
            write_whole(folder / name, text)
    return {"out": str(out), "views": len(models)}


def _read(path: Path, images: Path) -> PosedImage:
    """Return the image of a camera model with its lens and pose."""
    import mrcal  # loading it takes a while

    try:
        model = mrcal.cameramodel(str(path))
    except Exception as failure:  # mrcal raises what it likes
        raise BadValue(
            f"{path}: is not a camera model that can be read ({failure}); write it with mrcal again".replace("\n", " ")
        ) from failure
    name, numbers = model.intrinsics()
    if name not in _MODELS:
        raise BadValue(
            f"{path}: its lens is {name}; convert it with mrcal-convert-lensmodel to one of {sorted(_MODELS)}"
        )
    fx_px, fy_px, cx_px, cy_px, *distortion = numbers.tolist()
    width, height = model.imagersize().tolist()
    try:
        lens = Lens((width, height), fx_px, fy_px, cx_px, cy_px, tuple(distortion))
    except ValueError as failure:
        raise BadValue(f"{path}: {failure}; calibrate again") from failure
    return PosedImage(_image_of(path, images), lens, model.rt_cam_ref())


def _image_of(path: Path, folder: Path) -> Path:
    """Return the image of a camera model's name."""
    for suffix in sorted(IMAGE_SUFFIXES):
        image = folder / f"{path.stem}{suffix}"
        if image.is_file():
            return image
    raise MissingFile(f"{folder}: holds no image named {path.stem}; put it there, or name its folder with --images")
