"""Observations sorted for the solver: which views count, in which order, and where each corner goes."""

import numpy as np
import pytest

from faintfield.calib.errors import TooFewViews
from faintfield.calib.geometry import BoardObservation, Target
from faintfield.calib.geometry.observations import gather

SHAPES = {"small": (3, 4), "large": (5, 4)}


def seen(
    node: tuple[int, int], board: str, corners: list[int], sweep: int = 0, sigma_px: float = 0.1
) -> BoardObservation:
    numbers = np.array(corners)
    pixels = np.column_stack([numbers + 10.0 * node[1], numbers + 100.0 * node[0]])
    return BoardObservation(node, Target(board, sweep), numbers, pixels, np.full(len(corners), sigma_px))


ALL_SMALL = list(range(12))


@pytest.mark.parametrize(
    ("corners", "counts"),
    [
        ([0, 1, 2, 3, 4, 5], True),
        ([0, 1, 2, 4, 5], False),  # five
        ([0, 4, 1, 5, 8, 9], True),  # two columns
        ([0, 1, 2, 3, 4, 7], True),  # two rows
    ],
)
def test_a_view_counts_with_six_corners_on_two_rows_and_two_columns(corners: list[int], counts: bool) -> None:
    other = seen((0, 1), "small", corners)
    found = gather([seen((0, 0), "small", ALL_SMALL), other], SHAPES, (0, 0))
    assert ((0, 1) in found.nodes) is counts
    assert found.corner_count == 12 + (len(corners) if counts else 0)


@pytest.mark.parametrize("line", [list(range(8)), list(range(0, 48, 8))], ids=["a row", "a column"])
def test_corners_on_one_line_do_not_count(line: list[int]) -> None:
    shapes = {"wide": (6, 8)}
    everything = seen((0, 0), "wide", list(range(48)))
    assert gather([everything, seen((0, 1), "wide", line)], shapes, (0, 0)).nodes == [(0, 0)]


def test_nodes_count_that_a_chain_of_boards_connects_to_the_reference_which_comes_first() -> None:
    views = [
        seen((2, 2), "small", ALL_SMALL, sweep=2),  # shares a board with no node that counts
        seen((0, 0), "large", ALL_SMALL, sweep=1),
        seen((0, 1), "large", ALL_SMALL, sweep=1),
        seen((1, 1), "small", ALL_SMALL),
        seen((0, 1), "small", ALL_SMALL),
    ]
    found = gather(views, SHAPES, (1, 1))
    assert found.nodes == [(1, 1), (0, 0), (0, 1)]
    assert found.targets == [Target("small", 0), Target("large", 1)]
    assert found.target_of.tolist() == [0, 0, 1, 1]
    assert found.node_of.tolist() == [0, 2, 1, 2]
    assert found.view_name(2) == "node (0, 0), board 'large', sweep 1"
    with pytest.raises(TooFewViews, match=r"node \(5, 5\)"):
        gather(views, SHAPES, (5, 5))


def test_corners_lie_on_the_lattice_of_the_largest_board_with_weights_relative_to_the_median_sigma() -> None:
    views = [
        seen((0, 0), "small", ALL_SMALL, sigma_px=0.1),
        seen((0, 0), "large", [0, 1, 4, 5, 18, 19], sigma_px=0.4),
    ]
    found = gather(views, SHAPES, (0, 0))
    assert found.pixels.shape == (2, 5, 4, 2)
    large, small = found.weights
    assert (small[:3] == 1.0).all()
    assert (small[3:] == -1.0).all()
    assert np.argwhere(large > 0).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1], [4, 2], [4, 3]]
    assert large[4, 3] == pytest.approx(0.25)
    assert found.pixels[0, 4, 3].tolist() == [19.0, 19.0]
    assert found.pixels[1, 2, 1].tolist() == [9.0, 9.0]
    assert not found.pixels[1, 3:].any()


def test_a_corner_that_the_board_does_not_have_is_refused() -> None:
    with pytest.raises(ValueError, match="board 'small' has no corner 12"):
        gather([seen((0, 0), "small", [*ALL_SMALL, 12])], SHAPES, (0, 0))
