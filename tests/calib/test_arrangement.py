"""What the pictures of a grid say of their order, against scenes whose order is known."""

from collections.abc import Callable

import numpy as np
import pytest

from faintfield.calib.arrangement.look import Look, look
from faintfield.calib.arrangement.occlusion import find_far_side
from faintfield.calib.arrangement.orientation import Orientation, counted
from faintfield.calib.arrangement.pictures import prepare
from tests.calib.light_fields import CARDS, Layer, Views, light_field, with_noise

# Added to all disparities: some cards then move with the camera, others against it; or all with it.
ALIGNED_PX, ALL_WITH_IT_PX = 2.4, 4.2


def _seen(views: Views, given: Orientation | None = None) -> Look:
    nodes = sorted(views)
    return look(nodes, lambda index: views[nodes[index]], given)


def _renamed(views: Views, name: Callable[[int, int], tuple[int, int]]) -> Views:
    return {name(*node): picture for node, picture in views.items()}


def _misnamed(views: Views, orientation: Orientation) -> Views:
    """Return views under such numbers that this orientation puts them right."""
    last = np.max(list(views), axis=0)

    def name(row: int, column: int) -> tuple[int, int]:
        row = last[0] - row if orientation.flip_rows else row
        column = last[1] - column if orientation.flip_columns else column
        return (int(column), int(row)) if orientation.transpose else (int(row), int(column))

    return _renamed(views, name)


@pytest.fixture(scope="module")
def aligned() -> Views:
    return light_field(grid=(5, 6), aligned_px=ALIGNED_PX)


@pytest.mark.parametrize(
    "wanted",
    [
        Orientation(False, False, True),
        Orientation(False, True, True),
        Orientation(True, True),
        Orientation(True, False, True),
    ],
    ids=str,
)
def test_order_is_found_in_aligned_pictures(wanted: Orientation, aligned: Views) -> None:
    misnamed = _misnamed(aligned, wanted)
    found = _seen(misnamed)
    assert found.orientation == wanted
    assert (found.direction, found.undecided, found.aligned) == ("pictures", False, True)
    # The views themselves are where they were rendered
    placed = dict(
        zip(found.orientation.of(sorted(misnamed)), (misnamed[node] for node in sorted(misnamed)), strict=True)
    )
    assert all(placed[node] is aligned[node] for node in aligned)


@pytest.mark.parametrize(("aligned_px", "least_px", "largest_px"), [(0.0, -3.8, -1.0), (ALL_WITH_IT_PX, 0.4, 3.2)])
def test_the_range_of_disparities_holds_all_layers_and_little_more(
    aligned_px: float, least_px: float, largest_px: float
) -> None:
    found = _seen(light_field(grid=(5, 5), aligned_px=aligned_px))
    assert found.disparity_px is not None
    assert found.disparity_px[0] < least_px + 0.05
    assert found.disparity_px[1] > largest_px - 0.05
    assert found.disparity_px[0] > least_px - 0.6
    assert found.disparity_px[1] < largest_px + 0.6
    # Where all points move with the camera, only hidden parts tell that nothing is reversed
    assert (found.orientation, found.direction) == (Orientation(), "pictures")


@pytest.mark.parametrize("reversed_order", [False, True])
def test_what_is_hidden_lies_on_the_far_side(reversed_order: bool) -> None:
    views = light_field(grid=(3, 3), aligned_px=ALIGNED_PX)
    if reversed_order:
        views = _renamed(views, lambda row, column: (2 - row, 2 - column))
    nodes = sorted(views)
    light = prepare(nodes, lambda index: views[nodes[index]]).light
    result = find_far_side(light, [(1, 1)], np.arange(-2, 2.1, 0.5), distance=1, ratio=1.0)
    assert (result.z > 5) is not reversed_order
    assert (result.z < -5) is reversed_order


def test_an_edge_of_brightness_is_no_edge_of_depth() -> None:
    # One slanted wall, as many layers side by side that touch: no part of it is hidden
    views = light_field((Layer(0.0),), grid=(5, 5), aligned_px=1.0)
    assert abs(_seen(views).side_z) < 4


@pytest.mark.parametrize(("ratio", "transpose"), [(1.5, False), (0.6, True)])
def test_another_pitch_along_columns_is_measured(ratio: float, transpose: bool) -> None:
    found = _seen(_misnamed(light_field(grid=(5, 5), ratio=ratio), Orientation(transpose)))
    assert found.orientation == Orientation(transpose)
    assert found.ratio == pytest.approx(ratio, rel=0.02)
    assert found.disparity_px is not None
    # The range is the one along rows of nodes for x over the ratio: that along y
    assert found.disparity_px[0] == pytest.approx(-3.8 * _range_scale(found), abs=0.7)


def _range_scale(found: Look) -> float:
    return found.ratio


def test_a_square_pitch_is_called_square(aligned: Views) -> None:
    assert _seen(aligned).ratio == 1.0


@pytest.mark.parametrize(
    ("along", "reversed_order", "transpose"),
    [("row", True, False), ("row", False, True), ("column", False, False), ("column", True, True)],
)
def test_a_single_row_or_column(along: str, reversed_order: bool, transpose: bool) -> None:
    views = light_field(grid=(1, 7) if along == "row" else (7, 1), aligned_px=ALIGNED_PX)
    wanted = Orientation(transpose, reversed_order, reversed_order)
    found = _seen(_misnamed(views, wanted))
    placed = found.orientation.of(sorted(_misnamed(views, wanted)))
    assert placed == wanted.of(sorted(_misnamed(views, wanted)))
    assert found.direction == "pictures"


def test_all_points_moving_against_the_camera_are_in_order() -> None:
    found = _seen(light_field((Layer(-1.5),), grid=(5, 5)))
    assert (found.orientation, found.direction, found.undecided) == (Orientation(), "signs", False)
    assert found.aligned is False


def test_one_plane_with_one_reversed_number_is_in_order_by_its_sign() -> None:
    for wanted in (Orientation(flip_rows=True), Orientation(flip_columns=True)):
        found = _seen(_misnamed(light_field((Layer(-1.5),), grid=(5, 5)), wanted))
        assert (found.orientation, found.direction, found.undecided) == (wanted, "signs", False)


def test_one_plane_moving_with_the_camera_is_undecided() -> None:
    assert _seen(light_field((Layer(1.5),), grid=(5, 5))).undecided


def test_one_plane_that_does_not_move_keeps_its_names() -> None:
    found = _seen(with_noise(light_field((Layer(0.0),), grid=(5, 5)), 20))
    assert (found.seen, found.orientation, found.direction) == (True, Orientation(), "names")
    assert (found.undecided, found.aligned) == (False, None)


def test_an_order_that_is_given_is_kept_and_contradicted(aligned: Views) -> None:
    for given in (Orientation(flip_rows=True), Orientation(transpose=True), Orientation().turned()):
        found = _seen(aligned, given)
        assert (found.orientation, found.contradicted) == (given, True)
    assert not _seen(aligned, Orientation()).contradicted


def test_noise_leaves_the_range_and_the_axes(aligned: Views) -> None:
    snr = 1.0
    found = _seen(with_noise(_misnamed(aligned, Orientation(transpose=True)), snr))
    assert found.seen
    assert found.orientation.transpose
    assert found.disparity_px is not None
    assert found.disparity_px[0] < -1.2
    assert found.disparity_px[1] > 1.2


def test_dark_pictures_keep_their_names(aligned: Views) -> None:
    snr = 0.16
    found = _seen(with_noise(aligned, snr))
    assert found.orientation == Orientation()
    assert not found.undecided
    assert found.odd == []


def test_pictures_of_noise_and_of_different_scenes_show_nothing() -> None:
    generator = np.random.default_rng(0)
    noise = {node: generator.random((96, 128), np.float32) for node in np.ndindex(5, 5)}
    assert not _seen(noise).seen
    scenes = {(r, c): light_field(grid=(1, 1), seed=5 * r + c)[0, 0] for r, c in np.ndindex(5, 5)}
    assert not _seen(scenes).seen


def test_views_that_do_not_fit_are_named_and_leave_the_rest(aligned: Views) -> None:
    spoilt = dict(aligned)
    spoilt[1, 2] = np.ascontiguousarray(aligned[1, 2][::-1, ::-1])
    spoilt[3, 4] = np.roll(aligned[3, 4], 11, axis=0)
    spoilt[0, 0] = light_field(CARDS, (1, 1), seed=99)[0, 0]
    found = _seen(spoilt)
    assert [sorted(spoilt)[index] for index in found.odd] == [(0, 0), (1, 2), (3, 4)]
    assert found.orientation == Orientation()


def test_copies_are_named(aligned: Views) -> None:
    nodes = sorted(aligned)
    copied = {**aligned, (2, 2): aligned[0, 1]}
    assert _seen(copied).copies == [(nodes.index((0, 1)), nodes.index((2, 2)))]
    assert _seen(aligned).copies == []


def test_missing_views_change_nothing(aligned: Views) -> None:
    left = {node: it for node, it in _misnamed(aligned, Orientation(flip_columns=True)).items() if sum(node) % 5}
    found = _seen(left)
    assert (found.orientation, found.direction) == (Orientation(flip_columns=True), "pictures")


def test_a_turned_and_a_shifted_view_are_measured(aligned: Views) -> None:
    import cv2

    nodes = sorted(aligned)
    changed = dict(aligned)
    turn = cv2.getRotationMatrix2D((79.5, 59.5), -2.0, 1.0)  # clockwise as seen, from x towards y
    changed[2, 3] = cv2.warpAffine(aligned[2, 3], turn, (160, 120), borderMode=cv2.BORDER_REFLECT).astype(np.float32)
    changed[1, 1] = np.roll(aligned[1, 1], 2, axis=0)
    found = _seen(changed)
    assert np.degrees(found.turn_rad[nodes.index((2, 3))]) == pytest.approx(2.0, abs=0.3)
    others = np.delete(np.degrees(found.turn_rad), nodes.index((2, 3)))
    assert np.abs(others).max() < 0.3
    assert found.shift_px[nodes.index((1, 1))] == pytest.approx([0.0, 2.0], abs=0.4)


def test_light_that_differs_is_measured(aligned: Views) -> None:
    brighter = {node: it * np.float32(1.5 if node == (4, 4) else 1.0) for node, it in aligned.items()}
    found = _seen(brighter)
    assert found.light[sorted(aligned).index((4, 4))] == pytest.approx(1.5, rel=0.1)
    assert found.orientation == Orientation()
    assert found.odd == []


def test_every_second_view_is_a_grid() -> None:
    assert counted([(4, 10), (4, 14), (8, 10), (10, 18)]) == [(0, 0), (0, 1), (2, 0), (3, 2)]
    assert counted([(3, 5)]) == [(0, 0)]
