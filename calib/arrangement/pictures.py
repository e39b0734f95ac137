"""Pictures of a grid prepared for matching: small, and without their brightness."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

type Picture = NDArray[np.float32]

# Longest side of the pictures that are matched finely and coarsely, px.
_FINE_PX, _COARSE_PX = 448, 144

# σ in px of the smoothing of pictures, and of the brightness that is taken off: wider than texture, narrower than
# shades of light.
_SMOOTHING_PX, _SHADES_PX = 0.8, 8.0

# σ in px of the smoothing before contrast is measured: it takes off noise, and leaves what scenes have.
_NOISE_PX = 2.0

# Standard deviation of normal noise over the median of its absolute values.
_SIGMA_OF_MEDIAN = 1.4826


@dataclass(frozen=True)
class GridPictures:
    """Pictures of the views, ready to be compared.

    Attributes
    ----------
    fine, coarse : list of float32 array (row, column)
        Pictures without their local brightness, at two sizes.
    brightness : list of float32 array (row, column)
        The fine pictures with their brightness, over their mean, in units of their texture's standard deviation.
    fine_scale, coarse_scale : float
        Pixels of the files per pixel of these.
    mean : array (view,)
        Mean of each picture in units of its file.
    contrast : float
        Median over the views of the standard deviation within a picture, smoothed, in units of the files.
    noise : float
        Median over the views of the standard deviation of what the smoothing took off, beside edges.
    """

    fine: list[Picture]
    coarse: list[Picture]
    brightness: list[Picture]
    fine_scale: float
    coarse_scale: float
    mean: NDArray[np.float64]
    contrast: float
    noise: float

    @property
    def relative_light(self) -> NDArray[np.float64]:
        """Mean of each picture (view,) over the median of all."""
        return self.mean / (float(np.median(self.mean)) or 1.0)

    def copies(self) -> list[tuple[int, int]]:
        """Return pairs of views whose pictures are the same in every pixel, as noise rules out."""
        first: dict[bytes, int] = {}
        contents = [picture.tobytes() if np.ptp(picture) else None for picture in self.brightness]
        return [
            (first[content], index)
            for index, content in enumerate(contents)
            if content is not None and first.setdefault(content, index) != index
        ]


def prepare_pictures(pictures: Iterable[Picture]) -> GridPictures:
    """Keep what matching needs of grey pictures (row, column) of one size; each is used once."""
    fine, coarse, brightness, means, contrasts, noises, textures = [], [], [], [], [], [], []
    for picture in pictures:
        means.append(float(picture.mean()))
        smooth = cv2.GaussianBlur(picture, (0, 0), _NOISE_PX)
        contrasts.append(float(smooth.std()))
        noises.append(_SIGMA_OF_MEDIAN * float(np.median(np.abs(picture - smooth))))
        small = _shrink(picture, _FINE_PX)
        tiny = _shrink(small, _COARSE_PX)
        scales = picture.shape[1] / small.shape[1], picture.shape[1] / tiny.shape[1]
        fine.append(_remove_brightness(small))
        coarse.append(_remove_brightness(tiny))
        brightness.append(small / np.float32(means[-1] or 1.0))
        textures.append((brightness[-1] - cv2.GaussianBlur(brightness[-1], (0, 0), _SHADES_PX)).std())
    texture = np.float32(np.median(textures) or 1.0)
    brightness = [picture / texture for picture in brightness]
    return GridPictures(
        fine, coarse, brightness, *scales, np.array(means), float(np.median(contrasts)), float(np.median(noises))
    )


def _shrink(picture: Picture, longest_px: int) -> Picture:
    """Return a picture reduced by a whole factor until no side is longer."""
    factor = -(-max(picture.shape) // longest_px)
    height, width = picture.shape[0] // factor, picture.shape[1] // factor
    cut = picture[: height * factor, : width * factor]
    return np.asarray(cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _remove_brightness(picture: Picture) -> Picture:
    """Return a picture less its local mean, over its contrast: shades and single bright spots count no more."""
    smooth = cv2.GaussianBlur(picture, (0, 0), _SMOOTHING_PX)
    detail = smooth - cv2.GaussianBlur(picture, (0, 0), _SHADES_PX)
    return np.asarray(np.clip(detail / (float(np.std(detail)) or 1.0), -4, 4), np.float32)
