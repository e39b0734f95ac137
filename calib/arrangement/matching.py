"""Agreement of blocks of a view with its neighbours, displaced along x and along y."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.pictures import Node, Picture

type Table = NDArray[np.float32]


@dataclass(frozen=True)
class Tables:
    """Correlation of the blocks of several views with their neighbours.

    Attributes
    ----------
    shifts_px : array (shift,)
        Displacements from one node to the next, symmetric about zero.
    along : dict of (number, axis) to array (view, block, shift)
        `number` 0 or 1 tells which number of the names steps by one, `axis` 0 displacement along x, 1 along y.
    """

    shifts_px: NDArray[np.floating]
    along: dict[tuple[int, int], Table]
    blocks: tuple[int, int]

    @property
    def numbers(self) -> list[int]:
        """The numbers along which there are neighbours."""
        return sorted({number for number, _ in self.along})


def neighbour(node: Node, number: int, steps: int) -> Node:
    """Return the node some steps further along one of its numbers."""
    return (node[0] + steps, node[1]) if number == 0 else (node[0], node[1] + steps)


def correlate(
    pictures: Mapping[Node, Picture],
    nodes: Sequence[Node],
    shifts_px: NDArray[np.floating],
    *,
    distance: int,
    block_px: int,
    turned: bool = False,
) -> Tables:
    """Correlate the blocks of some views with the views `distance` nodes before and after them.

    Parameters
    ----------
    pictures : mapping of node to array (row, column)
        Pictures without their brightness.
    nodes : sequence of (int, int)
        Views whose blocks are matched.
    shifts_px : array (shift,)
        Displacements from node to node, symmetric about zero; the view before shows the opposite ones.
    distance : int
        Nodes between the two views of a pair.
    block_px : int
        Side of a block.
    turned : bool
        Turn the other views by 180°, to see what agrees by chance.
    """
    others = {node: np.ascontiguousarray(it[::-1, ::-1]) for node, it in pictures.items()} if turned else pictures
    shape = next(iter(pictures.values())).shape
    blocks = _blocks(shape, block_px)
    along: dict[tuple[int, int], list[Table]] = {}
    for number in (0, 1):
        for axis in (0, 1):
            rows = []
            for node in nodes:
                sides = [
                    block_table(pictures[node], others[other], sign * distance * shifts_px, axis, block_px)
                    for sign in (1, -1)
                    if (other := neighbour(node, number, sign * distance)) in pictures
                ]
                empty = np.full((blocks[0] * blocks[1], len(shifts_px)), np.nan, np.float32)
                rows.append(np.mean(sides, axis=0, dtype=np.float32) if sides else empty)
            table = np.stack(rows)
            if np.isfinite(table).any():
                along[number, axis] = [table]
    return Tables(shifts_px, {key: tables[0] for key, tables in along.items()}, blocks)


def displaced(picture: Picture, x_px: float, y_px: float) -> Picture:
    """Return a picture whose pixel p shows what the given one shows at p plus a displacement; 0 beyond its edge."""
    if x_px == round(x_px) and y_px == round(y_px):
        return _displaced_by_whole(picture, round(x_px), round(y_px))
    matrix = np.array([[1, 0, x_px], [0, 1, y_px]], np.float64)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(picture, matrix, picture.shape[::-1], flags=flags), np.float32)


def _displaced_by_whole(picture: Picture, x_px: int, y_px: int) -> Picture:
    """Return a picture displaced by whole pixels, which needs no interpolation."""
    height, width = picture.shape
    moved = np.zeros_like(picture)
    if abs(x_px) < width and abs(y_px) < height:
        to = slice(max(-y_px, 0), height - max(y_px, 0)), slice(max(-x_px, 0), width - max(x_px, 0))
        of = slice(max(y_px, 0), height - max(-y_px, 0)), slice(max(x_px, 0), width - max(-x_px, 0))
        moved[to] = picture[of]
    return moved


def block_means(picture: Picture, blocks: tuple[int, int], block_px: int) -> NDArray[np.float32]:
    """Return the means (block,) over the blocks of a picture, row by row."""
    height, width = min(blocks[0] * block_px, picture.shape[0]), min(blocks[1] * block_px, picture.shape[1])
    return np.asarray(
        cv2.resize(picture[:height, :width], blocks[::-1], interpolation=cv2.INTER_AREA), np.float32
    ).ravel()


def _blocks(shape: tuple[int, ...], block_px: int) -> tuple[int, int]:
    """Return how many blocks a picture has, down and across."""
    return max(shape[0] // block_px, 1), max(shape[1] // block_px, 1)


def block_table(view: Picture, other: Picture, shifts_px: NDArray[np.floating], axis: int, block_px: int) -> Table:
    """Return the correlation (block, shift) of a view with another, displaced along an axis."""
    blocks = _blocks(view.shape, block_px)
    power = block_means(view * view, blocks, block_px)
    columns = []
    for shift_px in shifts_px:
        moved = displaced(other, shift_px, 0.0) if axis == 0 else displaced(other, 0.0, shift_px)
        both = block_means(view * moved, blocks, block_px)
        columns.append(both / np.sqrt(power * block_means(moved * moved, blocks, block_px) + 1e-4))
    return np.stack(columns, axis=1)
