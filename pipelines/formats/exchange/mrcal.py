"""mrcal's camera models, `.cameramodel` files: a lens and a pose each, lengths in metres as mrcal's tools have them."""

import ast
import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from faintfield.calib.geometry.bundle import LENS_MODELS, Bundle, load_mrcal
from faintfield.calib.geometry.mrcal_inputs import LENS, REFERENCE_POSE, seen_region_px, tool_inputs
from faintfield.calib.lens import Lens
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.exchange.imported_set import (
    ExportedSet,
    ImportedSet,
    PosedImage,
    check_set_free,
    export_posed,
    import_posed,
)
from faintfield.pipelines.formats.exchange.options import ImportOptions
from faintfield.pipelines.formats.files import write_whole
from faintfield.pipelines.formats.frames import IMAGE_SUFFIXES
from faintfield.pipelines.formats.reading import is_file, read_content

SUFFIX = ".cameramodel"

_MM_PER_M = 1000.0

# Number of distortion coefficients of each lens model.
_COUNTS = {"pinhole": 0, "opencv4": 4, "opencv5": 5, "opencv8": 8}

# Size in bytes up to which a camera model is read, without the measurements that it was calibrated from.
_MAX_LITERAL_BYTES = 1_000_000

type _Pose = tuple[float, float, float, float, float, float]


class _CameraModel(msgspec.Struct, frozen=True):
    """Part of a .cameramodel that is read; `extrinsics` is the older name of the pose."""

    lensmodel: str
    intrinsics: Annotated[tuple[float, ...], msgspec.Meta(min_length=4)]
    imagersize: tuple[int, int]
    rt_cam_ref: _Pose | None = None
    extrinsics: _Pose | None = None

    def __post_init__(self) -> None:
        if self.pose is None:
            raise ValueError("it states no rt_cam_ref")

    @property
    def pose(self) -> _Pose | None:
        """The camera's pose, Rodrigues rad and mrcal's unit of length."""
        return self.rt_cam_ref if self.rt_cam_ref is not None else self.extrinsics


def camera_model_text(lens: Lens, lens_model: str, rt_cam_ref: ArrayLike) -> str:
    """Return a camera of pose (6,), Rodrigues rad and mm, as the text of a .cameramodel file.

    The distortion is filled with zeros to the length that the lens model has: "pinhole", "opencv4", "opencv5" or
    "opencv8".
    """
    padding = [0.0] * (_COUNTS[lens_model] - len(lens.distortion))
    model = load_mrcal().cameramodel(
        intrinsics=(LENS_MODELS[lens_model], np.array([*lens.parameters, *padding])),
        imagersize=np.array(lens.size_px, np.int32),
        rt_cam_ref=np.array(rt_cam_ref, np.float64) * [1, 1, 1, 1e-3, 1e-3, 1e-3],
    )
    return _text_of(model)


def solution_text(bundle: Bundle) -> str:
    """Return the lens at the reference node as the text of a .cameramodel file, with mrcal's optimization inputs.

    From these mrcal's tools show the uncertainty of projections and the residuals. The valid region of the lens is the
    hull of all corners that were seen.
    """
    model = load_mrcal().cameramodel(
        optimization_inputs=tool_inputs(bundle), icam_intrinsics=LENS, icam_extrinsics=REFERENCE_POSE
    )
    model.valid_intrinsics_region(seen_region_px(bundle))
    return _text_of(model)


def _text_of(model: Any) -> str:
    text = io.StringIO()
    model.write(text)
    return text.getvalue()


def import_camera_models(src: Path, out: Path, options: ImportOptions) -> ImportedSet:
    """Make an elemental set of the models in a folder and their images."""
    check_set_free(out, options)
    options = replace(options, mm_per_unit=options.mm_per_unit or _MM_PER_M)
    models = read_camera_models(src, options.images or src)
    return import_posed(out, list(models), list(models.values()), options, "import mrcal")


def export_camera_models(set_path: Path, out: Path, *, overwrite: bool) -> ExportedSet:
    """Write the lens and poses of a set or session, a model for each view."""

    def write(folder: Path, views: list[PosedImage]) -> None:
        for view in views:
            file = folder / view.path.with_suffix(SUFFIX).name
            if file.exists():
                raise BadValue(f"{set_path}: {view.path} would become {file.name} like another view; rename its image")
            # The smallest model that holds the distortion
            model = next(name for name, count in _COUNTS.items() if count >= len(view.lens.distortion))
            write_whole(file, camera_model_text(view.lens, model, view.rt_cam_world))

    return export_posed(set_path, out, "m", [f"*{SUFFIX}"], write, overwrite=overwrite)


def read_camera_models(folder: Path, images: Path) -> dict[Path, PosedImage]:
    """Return the image of each .cameramodel file in a folder, which has the same name in the folder `images`.

    Raises
    ------
    MissingFile, BadValue
        There are no models, a model has no image, or a model cannot be read.
    """
    paths = sorted(folder.glob(f"*{SUFFIX}"))
    if not paths:
        raise MissingFile(f"{folder}: holds no {SUFFIX} files; name the folder that holds one per image")
    return {path: _read(path, images) for path in paths}


def _read(path: Path, images: Path) -> PosedImage:
    model = _literal(path)
    known = {LENS_MODELS[name]: count for name, count in _COUNTS.items()}
    if model.lensmodel not in known:
        raise BadValue(
            f"{path}: its lens is {model.lensmodel}; convert it with mrcal-convert-lensmodel to one of {list(known)}"
        )
    count = len(model.intrinsics) - 4
    if count != known[model.lensmodel]:
        raise BadValue(
            f"{path}: states {count} coefficients of distortion, {model.lensmodel} has {known[model.lensmodel]}; "
            "write it with mrcal again"
        )
    try:
        lens = Lens.from_parameters(model.imagersize, np.array(model.intrinsics))
    except ValueError as failure:
        raise BadValue(f"{path}: {failure}; calibrate again") from failure
    candidates = (images / f"{path.stem}{suffix}" for suffix in sorted(IMAGE_SUFFIXES))
    image = next(filter(is_file, candidates), None)
    if image is None:
        raise MissingFile(f"{images}: holds no image named {path.stem}; put it there, or name its folder with --images")
    return PosedImage(image, lens, np.array(model.pose))


def _literal(path: Path) -> _CameraModel:
    """Return the content of a camera model, which is the text of a Python dictionary; nothing in it is executed."""
    # The measurements that mrcal's own tools store may be megabytes of text without quotes
    content = re.sub(rb"b'[^'\\\n]*+'", b"b''", read_content(path))
    if len(content) > _MAX_LITERAL_BYTES:
        raise BadValue(
            f"{path}: has {len(content)} bytes besides its optimization_inputs, {_MAX_LITERAL_BYTES} are read at most; "
            "write it with mrcal again"
        )
    try:
        return msgspec.convert(ast.literal_eval(content.decode()), _CameraModel)
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError) as failure:  # MemoryError: nested too deep
        reason = " ".join(str(failure).split()) or type(failure).__name__
        raise BadValue(
            f"{path}: is not a camera model that can be read ({reason}); write it with mrcal again"
        ) from failure
