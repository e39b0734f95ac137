"""The pictures of a grid, prepared for matching: small, without their brightness, at two sizes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

type Node = tuple[int, int]
type Picture = NDArray[np.float32]

# Longest side of the pictures that are matched finely and coarsely, px.
_FINE_PX, _COARSE_PX = 448, 144

# Smallest side of pictures that can be matched, px.
MIN_SIDE_PX = 32

# σ in px of the smoothing of pictures, and of the brightness that is taken off: wider than texture, narrower than
# shades of light.
_SMOOTHING_PX, _SHADES_PX = 0.8, 8.0

# σ in px of the smoothing before contrast is measured: it takes off noise, and leaves what scenes have.
_NOISE_PX = 2.0

# Standard deviation of normal noise over the median of its absolute values.
_SIGMA_OF_MEDIAN = 1.4826


@dataclass(frozen=True)
class Views:
    """Pictures by node, ready to be compared.

    Attributes
    ----------
    fine, coarse : dict of node to float32 array (row, column)
        Pictures without their local brightness, at two sizes.
    light : dict of node to float32 array (row, column)
        The fine pictures with their brightness, over their mean, in units of their texture's standard deviation.
    fine_scale, coarse_scale : float
        Pixels of the files per pixel of these.
    mean : dict of node to float
        Mean of each picture in units of its file.
    contrast : float
        Median over the views of the standard deviation within a picture, smoothed, in units of the files.
    noise : float
        Median over the views of the standard deviation of what the smoothing took off, beside edges.
    """

    fine: dict[Node, Picture]
    coarse: dict[Node, Picture]
    light: dict[Node, Picture]
    fine_scale: float
    coarse_scale: float
    mean: dict[Node, float]
    contrast: float
    noise: float

    @property
    def nodes(self) -> list[Node]:
        """Nodes in the order given."""
        return list(self.fine)


def prepare(nodes: Sequence[Node], read: Callable[[int], Picture]) -> Views:
    """Read all pictures once and keep what matching needs.

    Parameters
    ----------
    nodes : sequence of (int, int)
        The two numbers of each view.
    read : callable
        Returns the grey picture (row, column) of a view by its place in `nodes`; all have one size.
    """
    fine, coarse, light, means, contrasts, noises = {}, {}, {}, {}, [], []
    scales = (1.0, 1.0)
    for index, node in enumerate(nodes):
        picture = np.asarray(read(index), np.float32)
        means[node] = float(picture.mean())
        smooth = cv2.GaussianBlur(picture, (0, 0), _NOISE_PX)
        contrasts.append(float(smooth.std()))
        noises.append(_SIGMA_OF_MEDIAN * float(np.median(np.abs(picture - smooth))))
        small = _shrunk(picture, _FINE_PX)
        tiny = _shrunk(small, _COARSE_PX)
        scales = picture.shape[1] / small.shape[1], picture.shape[1] / tiny.shape[1]
        fine[node], coarse[node] = _without_brightness(small), _without_brightness(tiny)
        light[node] = small / np.float32(means[node] or 1.0)
    texture = (
        float(np.median([(view - cv2.GaussianBlur(view, (0, 0), _SHADES_PX)).std() for view in light.values()])) or 1.0
    )
    light = {node: view / np.float32(texture) for node, view in light.items()}
    return Views(fine, coarse, light, *scales, means, float(np.median(contrasts)), float(np.median(noises)))


def copies(views: Views) -> list[tuple[Node, Node]]:
    """Return pairs of nodes whose pictures are the same in every pixel, as noise rules out."""
    first: dict[bytes, Node] = {}
    found = []
    for node, picture in views.light.items():
        content = np.ascontiguousarray(picture).tobytes()
        if content in first and picture.std() > 0:
            found.append((first[content], node))
        first.setdefault(content, node)
    return found


def spread(nodes: Sequence[Node], count: int) -> list[Node]:
    """Return at most `count` nodes, spread evenly over the list."""
    if not nodes or count < 1:
        return []
    chosen = np.unique(np.linspace(0, len(nodes) - 1, min(count, len(nodes))).round().astype(int))
    return [nodes[index] for index in chosen]


def _shrunk(picture: Picture, longest_px: int) -> Picture:
    """Return a picture reduced by a whole factor until no side is longer."""
    factor = -(-max(picture.shape) // longest_px)
    if factor == 1:
        return picture
    height, width = picture.shape[0] // factor, picture.shape[1] // factor
    cut = picture[: height * factor, : width * factor]
    return np.asarray(cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _without_brightness(picture: Picture) -> Picture:
    """Return a picture less its local mean, over its local contrast: shades and single bright spots count no more."""
    smooth = cv2.GaussianBlur(picture, (0, 0), _SMOOTHING_PX)
    detail = smooth - cv2.GaussianBlur(picture, (0, 0), _SHADES_PX)
    scale = float(np.std(detail)) or 1.0
    return np.asarray(np.clip(detail / scale, -4, 4), np.float32)
