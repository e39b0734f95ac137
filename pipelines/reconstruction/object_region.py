"""The object region of the reference view: as a set states it, or segmented on a view in plenty of light."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet

# Mask of the objects in the reference view, beside a set's images if it is known.
OBJECT_REGION = "object_region.png"

type Region = NDArray[np.bool_]


def object_region(loaded: ElementalSet, path: Path | None = None) -> tuple[Region | None, str]:
    """Return the object region (row, column) of the reference view, None if it is not known, and its name.

    Parameters
    ----------
    loaded : ElementalSet
        The set.
    path : Path, optional
        Mask to use instead of the set's own.
    """
    path = path or loaded.folder / OBJECT_REGION
    if path.is_file():
        return read_frame(path).pixels_dn > 127, "object region"
    light_e = bright_electrons(loaded)
    region = None if light_e is None else segmented(light_e, ~loaded.unusable)
    return (None, "whole view") if region is None else (region, "object region of the bright view")


def bright_electrons(loaded: ElementalSet) -> NDArray[np.float32] | None:
    """Return the electrons of the reference view in plenty of light (row, column), above dark; None if there is none.

    A colour camera gives the mean of the colours around each pixel, enough to tell where objects are.
    """
    if loaded.bright_view is None:
        return None
    path, exposure_s = loaded.bright_view
    frame = read_frame(path)
    pixels = frame.pixels_dn if frame.pixels_dn.ndim == 2 else frame.pixels_dn.mean(axis=2)
    light_e = loaded.noise.electrons(pixels) - np.asarray(loaded.noise.background_e(exposure_s), np.float32)
    mosaic = loaded.settings.camera.mosaic or frame.mosaic
    return np.asarray(light_e if mosaic is None else cv2.blur(light_e, (len(mosaic[0]), len(mosaic))), np.float32)


def segmented(light_e: NDArray[np.float32], usable: Region) -> Region | None:
    """Return the object region (row, column): above Li's threshold; None if the brightness is uniform.

    Li's threshold minimises the cross entropy between an image and its two levels, which weights a difference relative
    to the brightness, as suits photon counts. Otsu's weights its square, and misses the darker parts of objects.
    """
    from skimage.filters import threshold_li  # loading it takes a while

    level = light_e[usable]
    if not level.size or not np.ptp(level):
        return None
    region: Region = (light_e > threshold_li(level)) & usable
    return region if region.any() else None
