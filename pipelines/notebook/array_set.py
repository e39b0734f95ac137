"""An elemental set of arrays in memory, checked as one of files is."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintfield.calib.lens import Lens
from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.exchange.imported_set import relative
from faintfield.pipelines.formats.frames import Frame
from faintfield.pipelines.formats.sets.elemental_file import Camera, ElementalSetFile, View, check_settings
from faintfield.pipelines.formats.sets.elemental_set import MAX_RESPONSE, ElementalSet

# Stands for the folder of the set in messages, and for the file of its noise.
_PLACE, _NOISE = Path("arrays"), "noise"


def set_of_arrays(
    images: ArrayLike,
    poses: ArrayLike,
    lens: Lens,
    noise: NoiseModel,
    *,
    reference: int | None = None,
    nodes: Sequence[tuple[int, int]] | None = None,
    exposure_s: float | None = None,
    mosaic: Sequence[str] | None = None,
    flat: ArrayLike | None = None,
    unusable: ArrayLike | None = None,
) -> ElementalSet:
    """Return the elemental set of arrays; see `LightField.from_arrays`."""
    _check_types(lens, noise)
    stack, rt = np.asarray(images), np.asarray(poses, np.float64)
    _check_images(stack, lens)
    if rt.shape != (len(stack), 6):
        raise BadValue(
            f"poses: {len(stack)} views need an array of shape ({len(stack)}, 6), got {rt.shape}; give for each "
            "view a Rodrigues vector in rad and a translation in mm, from reference to camera"
        )
    if not np.isfinite(rt).all():
        view = int(np.flatnonzero(~np.isfinite(rt).all(axis=1))[0])
        raise BadValue(f"poses: that of view {view} is {rt[view].tolist()}; give finite numbers, or leave the view out")
    if exposure_s is None and np.any(noise.dark_current_e_per_s):
        raise BadValue("noise: a dark current means nothing without an exposure; give exposure_s in seconds")
    if mosaic is not None and stack.ndim == 4:
        raise BadValue("mosaic: images in colour have none; leave it out, or give raw images")
    if nodes is not None and len(nodes) != len(stack):
        raise BadValue(f"nodes: got {len(nodes)} for {len(stack)} views; give row and column of each")
    if reference is not None and not 0 <= reference < len(stack):
        raise BadValue(f"reference: got {reference} for {len(stack)} views; give 0 to {len(stack) - 1}")
    reference = _reference(rt) if reference is None else reference
    views = [
        View(f"view {number}", _pose(relative(pose, rt[reference])), None if nodes is None else nodes[number])
        for number, pose in enumerate(rt)
    ]
    size_px = lens.size_px
    camera = Camera(size_px, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, lens.distortion, mosaic=_rows(mosaic))
    settings = ElementalSetFile(
        format=1, exposure_s=exposure_s, reference_view=reference, camera=camera, noise=_NOISE, view=views
    )
    check_settings(_PLACE, settings)
    _check_maps(noise, size_px)
    frames = {_PLACE / view.image: image for view, image in zip(views, stack, strict=True)}
    return ElementalSet(
        _PLACE,
        settings,
        noise,
        flat=_map("flat", flat, size_px, np.float32),
        unusable=np.zeros(size_px[::-1], bool) if unusable is None else _map("unusable", unusable, size_px, np.bool_),
        read_frame=lambda path, _: Frame(frames[path]),
        in_memory=True,
    )


def _check_types(lens: object, noise: object) -> None:
    for name, value, kind in (("lens", lens, Lens), ("noise", noise, NoiseModel)):
        if not isinstance(value, kind):
            raise BadValue(f"{name}: got a {type(value).__name__}; give a faintfield.{kind.__name__}")


def _check_images(images: NDArray[Any], lens: Lens) -> None:
    width, height = lens.size_px
    if images.ndim not in (3, 4) or images.shape[1:] not in ((height, width), (height, width, 3)) or not len(images):
        raise BadValue(
            f"images: got an array of shape {images.shape} for a lens of {width} x {height} px; give one of shape "
            f"(view, {height}, {width}), or (view, {height}, {width}, 3) in colour"
        )
    if images.dtype.kind not in "uif":
        raise BadValue(f"images: got {images.dtype}; give whole or real numbers, in DN as the noise model counts")


def _check_maps(noise: NoiseModel, size_px: tuple[int, int]) -> None:
    for name in ("offset_dn", "gain_dn_per_e", "read_noise_e", "dark_current_e_per_s"):
        shape = np.shape(getattr(noise, name))
        if shape not in ((), size_px[::-1]):
            raise BadValue(f"noise: {name} has shape {shape}; give one number, or a map of shape {size_px[::-1]}")


def _reference(poses: NDArray[np.float64]) -> int:
    """Return the view whose pose is zero."""
    zero = np.flatnonzero((poses == 0).all(axis=1))
    if not zero.size:
        raise BadValue("poses: none is zero, so none is that of the reference view; give its number as reference")
    return int(zero[0])


def _map(name: str, values: ArrayLike | None, size_px: tuple[int, int], dtype: Any) -> Any:
    if values is None:
        return None
    array = np.asarray(values, dtype)
    if array.shape != size_px[::-1] or not ((array >= 0) & (array <= MAX_RESPONSE)).all():
        raise BadValue(
            f"{name}: got an array of shape {array.shape}; give numbers from 0 to {MAX_RESPONSE:g}, of shape "
            f"{size_px[::-1]}, for each pixel of the detector"
        )
    return array


def _pose(rt: NDArray[np.float64]) -> tuple[float, float, float, float, float, float]:
    a, b, c, x, y, z = rt.tolist()
    return a, b, c, x, y, z


def _rows(mosaic: Sequence[str] | None) -> tuple[str, ...] | None:
    return None if mosaic is None else tuple(mosaic)
