"""Views of a grid: their nodes, and their pictures prepared for matching: small, and without their brightness."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

type Node = tuple[int, int]
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
class Orientation:
    """Map from the two numbers of a name to row and column: swapped first, then reversed."""

    transpose: bool = False
    flip_rows: bool = False
    flip_columns: bool = False

    @property
    def opposed(self) -> bool:
        """One of rows and columns is reversed."""
        return self.flip_rows != self.flip_columns

    def turned(self) -> "Orientation":
        """Return the orientation turned by 180°."""
        return Orientation(self.transpose, not self.flip_rows, not self.flip_columns)

    def apply(self, nodes: Sequence[Node]) -> list[Node]:
        """Return row and column of each node, counted from zero."""
        numbers = np.array(nodes)[:, ::-1] if self.transpose else np.array(nodes)
        numbers = numbers - numbers.min(axis=0)
        numbers = np.where([self.flip_rows, self.flip_columns], numbers.max(axis=0) - numbers, numbers)
        return [(row, column) for row, column in numbers.tolist()]


def neighbour(node: Node, number: int, steps: int) -> Node:
    """Return the node some steps further along one of its numbers."""
    return (node[0] + steps, node[1]) if number == 0 else (node[0], node[1] + steps)


def neighbour_counts(nodes: Sequence[Node], distance: int) -> NDArray[np.intp]:
    """Return how many neighbours (node, number) each node has at a distance along either number: 0, 1 or 2."""
    present = set(nodes)
    return np.array(
        [[sum(neighbour(node, n, sign * distance) in present for sign in (-1, 1)) for n in (0, 1)] for node in nodes]
    )


def central_nodes(nodes: Sequence[Node], count: int, distance: int, *, fill: bool = True) -> list[Node]:
    """Return at most `count` nodes between most pairs of neighbours, evenly spread, filled up with others."""
    counts = neighbour_counts(nodes, distance)
    ranks = 10 * (counts == 2).sum(axis=1) + counts.sum(axis=1)
    chosen: list[Node] = []
    for rank in np.unique(ranks)[::-1] if fill else [ranks.max()]:
        alike = [node for node, own in zip(nodes, ranks, strict=True) if own == rank]
        chosen += spread(alike, count - len(chosen))
    return chosen


def spread(nodes: Sequence[Node], count: int) -> list[Node]:
    """Return at most `count` nodes, spread evenly over the list."""
    if count < 1:
        return []
    chosen = np.unique(np.linspace(0, len(nodes) - 1, min(count, len(nodes))).round().astype(int))
    return [nodes[index] for index in chosen]


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
    contrast, noise : float
        Medians over the views of the standard deviation within a smoothed picture, and of what the smoothing took off,
        beside edges; in units of the files.
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
    contrast, noise = float(np.median(contrasts)), float(np.median(noises))
    return GridPictures(fine, coarse, brightness, *scales, np.array(means), contrast, noise)


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
