"""Where the objects are in the reference view: as a set states it, or segmented on a view in plenty of light."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import LoadedSet

# Beside a set's images, where it is known: the object region of the reference view.
OBJECT_REGION = "object_region.png"

type Region = NDArray[np.bool_]


def object_region(loaded: LoadedSet, path: Path | None = None) -> tuple[Region | None, str]:
    """Return the object region (row, column) of the reference view, None where nobody knows it, and its words.

    Parameters
    ----------
    loaded : LoadedSet
        The set.
    path : Path, optional
        A mask to take instead of the set's own.
    """
    path = path or loaded.folder / OBJECT_REGION
    if path.is_file():
        return read_frame(path).pixels_dn > 127, "object region"
    light_e = bright_electrons(loaded)
    region = None if light_e is None else segmented(light_e, ~loaded.unusable)
    return (None, "whole view") if region is None else (region, "object region of the bright view")


def bright_electrons(loaded: LoadedSet) -> NDArray[np.float32] | None:
    """Return the reference view in plenty of light (row, column), above the dark; None where there is none.

    Of a colour camera it is the mean of the colours about each pixel: where an object is, and no more.
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
    """Return where there is an object (row, column): above Li's threshold; None where all is of one brightness.

    Li's threshold minimises the cross entropy of an image and its two levels, which counts a difference relative to the
    brightness as counts of photons ask for. Otsu's, which counts its square, leaves the darker parts of objects out.
    """
    from skimage.filters import threshold_li  # loading it takes a while

    level = light_e[usable]
    if not level.size or not np.ptp(level):
        return None
    region: Region = (light_e > threshold_li(level)) & usable
    return region if region.any() else None
