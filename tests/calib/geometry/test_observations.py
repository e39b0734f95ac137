"""Observations sorted for the solver: which views count, in which order, and where each corner goes."""

import numpy as np
import pytest

from faintfield.calib.errors import TooFewViews
from faintfield.calib.geometry import BoardObservation, Target
from faintfield.calib.geometry.observations import gather

SHAPES = {"small": (3, 4), "large": (5, 4), "wide": (6, 8)}
ALL_SMALL, ALL_WIDE = list(range(12)), list(range(48))


def view(
    node: tuple[int, int], board: str, corners: list[int], sweep: int = 0, sigma_px: float = 0.1
) -> BoardObservation:
    numbers = np.array(corners)
    pixels = np.column_stack([numbers + 10.0 * node[1], numbers + 100.0 * node[0]])
    return BoardObservation(node, Target(board, sweep), numbers, pixels, np.full(len(corners), sigma_px))


@pytest.mark.parametrize(
    ("board", "corners", "counts"),
    [
        ("small", [0, 1, 2, 3, 4, 5], True),
        ("small", [0, 1, 2, 4, 5], False),  # five
        ("small", [0, 4, 1, 5, 8, 9], True),  # two columns
        ("small", [0, 1, 2, 3, 4, 7], True),  # two rows
        ("wide", list(range(8)), False),  # one row
        ("wide", list(range(0, 48, 8)), False),  # one column
    ],
)
def test_view_counts_with_six_corners_off_a_line(board: str, corners: list[int], counts: bool) -> None:
    whole = ALL_SMALL if board == "small" else ALL_WIDE
    result = gather([view((0, 0), board, whole), view((0, 1), board, corners)], SHAPES, (0, 0))
    assert ((0, 1) in result.nodes) is counts
    assert result.corner_count == len(whole) + (len(corners) if counts else 0)


def test_nodes_are_connected_to_the_reference_by_boards() -> None:
    views = [
        view((2, 2), "small", ALL_SMALL, sweep=2),  # shares a board with no node that counts
        view((0, 0), "large", ALL_SMALL, sweep=1),
        view((0, 1), "large", ALL_SMALL, sweep=1),
        view((1, 1), "small", ALL_SMALL),
        view((0, 1), "small", ALL_SMALL),
    ]
    result = gather(views, SHAPES, (1, 1))
    assert result.nodes == [(1, 1), (0, 0), (0, 1)]
    assert result.targets == [Target("small", 0), Target("large", 1)]
    assert result.target_of.tolist() == [0, 0, 1, 1]
    assert result.node_of.tolist() == [0, 2, 1, 2]
    assert result.view_name(2) == "node (0, 0), board 'large', sweep 1"
    with pytest.raises(TooFewViews, match=r"node \(5, 5\)"):
        gather(views, SHAPES, (5, 5))


def test_corners_have_lattice_places_and_relative_weights() -> None:
    views = [
        view((0, 0), "small", ALL_SMALL, sigma_px=0.1),
        view((0, 0), "large", [0, 1, 4, 5, 18, 19], sigma_px=0.4),
    ]
    result = gather(views, SHAPES, (0, 0))
    assert result.pixels.shape == (2, 5, 4, 2)
    large, small = result.weights
    assert (small[:3] == 1.0).all()
    assert (small[3:] == -1.0).all()
    assert np.argwhere(large > 0).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1], [4, 2], [4, 3]]
    assert large[4, 3] == pytest.approx(0.25)  # relative to the median sigma
    assert result.pixels[0, 4, 3].tolist() == [19.0, 19.0]
    assert result.pixels[1, 2, 1].tolist() == [9.0, 9.0]
    assert not result.pixels[1, 3:].any()


def test_corner_outside_the_board_is_refused() -> None:
    with pytest.raises(ValueError, match="board 'small' has no corner 12"):
        gather([view((0, 0), "small", [*ALL_SMALL, 12])], SHAPES, (0, 0))
