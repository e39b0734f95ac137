"""Order of the pictures of a grid, against scenes whose order is known."""

import cv2
import numpy as np
import pytest

from faintfield.calib.arrangement.inspection import GridInspection, inspect_grid, pitch_ratio
from faintfield.calib.arrangement.matching import Axes, Correlations, disparity_range
from faintfield.calib.arrangement.neighbours import compare_pair
from faintfield.calib.arrangement.views import Orientation, prepare_pictures
from tests.calib.light_fields import CARDS, Layer, Views, light_field, with_noise

# Added to all disparities: some cards then move with the camera, others against it; or all with it.
ALIGNED_PX, ALL_WITH_IT_PX = 2.4, 4.2


def inspect(views: Views, prescribed: Orientation | None = None) -> GridInspection:
    nodes = sorted(views)
    return inspect_grid(nodes, prepare_pictures(views[node] for node in nodes), prescribed)


def _misnamed(views: Views, orientation: Orientation) -> Views:
    """Return views under such numbers that this orientation puts them right."""
    last = np.max(list(views), axis=0)

    def name(row: int, column: int) -> tuple[int, int]:
        row = last[0] - row if orientation.flip_rows else row
        column = last[1] - column if orientation.flip_columns else column
        return (int(column), int(row)) if orientation.transpose else (int(row), int(column))

    return {name(*node): picture for node, picture in views.items()}


@pytest.fixture(scope="module")
def aligned() -> Views:
    return light_field(grid=(3, 4), aligned_px=ALIGNED_PX)


@pytest.mark.parametrize(
    "wanted",
    [Orientation(False, True, True), Orientation(True, True)],
    ids=str,
)
def test_order_is_read_from_aligned_pictures(wanted: Orientation, aligned: Views) -> None:
    misnamed = _misnamed(aligned, wanted)
    result = inspect(misnamed)
    assert result.orientation == wanted
    assert (result.direction, result.undecided, result.aligned) == ("pictures", False, True)
    assert result.ratio == 1.0
    placed = dict(zip(result.orientation.apply(sorted(misnamed)), sorted(misnamed), strict=True))
    assert all(misnamed[placed[node]] is aligned[node] for node in aligned), "views are where they were rendered"


@pytest.mark.parametrize(
    ("side", "aligned_px", "least_px", "largest_px"), [(5, 0.0, -3.8, -1.0), (4, ALL_WITH_IT_PX, 0.4, 3.2)]
)
def test_disparity_range_holds_all_layers(side: int, aligned_px: float, least_px: float, largest_px: float) -> None:
    result = inspect(light_field(grid=(side, side), aligned_px=aligned_px))
    assert least_px - 0.6 < result.range_px[0] < least_px + 0.05
    assert largest_px - 0.05 < result.range_px[1] < largest_px + 0.6
    # Where all points move with the camera, only hidden parts tell that nothing is reversed
    assert (result.orientation, result.direction) == (Orientation(), "pictures")


def test_edge_of_brightness_is_no_edge_of_depth() -> None:
    assert abs(inspect(light_field((Layer(0.0),), grid=(4, 4), aligned_px=1.0)).side_z) < 4


@pytest.mark.parametrize("aligned_px", [pytest.param(0.0, marks=pytest.mark.deep), ALIGNED_PX])
def test_ground_without_texture_says_nothing(aligned_px: float) -> None:
    result = inspect(light_field(CARDS[1:], grid=(4, 4), aligned_px=aligned_px))
    assert abs(result.side_z) < 4
    assert result.orientation == Orientation()


def test_pitch_ratio_is_measured() -> None:
    ratio, order = 0.6, Orientation(transpose=True)
    result = inspect(_misnamed(light_field(grid=(4, 4), ratio=ratio), order))
    assert result.orientation == order
    assert result.ratio == pytest.approx(ratio, rel=0.02)
    # The range is the one along rows of nodes for x over the ratio: that along y
    assert result.range_px[0] == pytest.approx(-3.8 * result.ratio, abs=0.7)


@pytest.mark.deep
def test_views_off_the_grid_do_not_make_it_oblong() -> None:
    """Shifts of views against a regular grid must not be taken for another pitch."""
    generator = np.random.default_rng(2)
    views = {
        node: np.roll(picture, generator.integers(-3, 4, 2), axis=(0, 1))
        for node, picture in light_field(grid=(5, 5)).items()
    }
    assert inspect(views).ratio == 1.0


@pytest.mark.parametrize(("grid", "transpose"), [((1, 7), False), ((7, 1), True)])
def test_reversed_single_line_is_put_in_order(grid: tuple[int, int], transpose: bool) -> None:
    wanted = Orientation(transpose, flip_rows=True, flip_columns=True)
    misnamed = _misnamed(light_field(grid=grid, aligned_px=ALIGNED_PX), wanted)
    result = inspect(misnamed)
    assert result.orientation.apply(sorted(misnamed)) == wanted.apply(sorted(misnamed))
    assert result.direction == "pictures"


@pytest.mark.parametrize("wanted", [Orientation(flip_rows=True), Orientation(flip_columns=True)], ids=str)
def test_plane_moving_against_the_camera_shows_order(wanted: Orientation) -> None:
    result = inspect(_misnamed(light_field((Layer(-1.5),), grid=(3, 3)), wanted))
    assert (result.orientation, result.direction, result.undecided) == (wanted, "signs", False)
    assert result.aligned is False


def test_plane_moving_with_the_camera_is_undecided() -> None:
    assert inspect(light_field((Layer(1.5),), grid=(3, 3))).undecided


def test_still_plane_keeps_its_names() -> None:
    result = inspect(with_noise(light_field((Layer(0.0),), grid=(3, 3)), 20))
    assert (result.failure, result.orientation, result.direction) == (None, Orientation(), "names")
    assert (result.undecided, result.aligned) == (False, None)


@pytest.mark.parametrize(
    "order",
    [Orientation(), Orientation(flip_rows=True), Orientation(transpose=True), Orientation().turned()],
    ids=str,
)
def test_wrong_prescribed_order_is_contradicted(order: Orientation, aligned: Views) -> None:
    result = inspect(aligned, order)
    assert (result.orientation, result.contradicted) == (order, order != Orientation())


def test_noise_leaves_the_range_and_the_axes() -> None:
    aligned = light_field(grid=(4, 5), aligned_px=ALIGNED_PX)
    result = inspect(with_noise(_misnamed(aligned, Orientation(transpose=True)), snr=1.0))
    assert result.failure is None
    assert result.orientation.transpose
    assert result.range_px[0] < -1.2
    assert result.range_px[1] > 1.2


@pytest.mark.parametrize("content", ["noise", pytest.param("scenes", marks=pytest.mark.deep)])
def test_unrelated_pictures_show_nothing(content: str) -> None:
    generator, nodes = np.random.default_rng(0), list(np.ndindex(3, 3))
    views = {node: generator.random((96, 128), np.float32) for node in nodes}
    if content == "scenes":
        views = {(r, c): light_field(grid=(1, 1), size_px=(128, 96), seed=5 * r + c)[0, 0] for r, c in nodes}
    assert inspect(views).failure == "dark"


def test_spoilt_views_are_named_and_do_not_matter() -> None:
    spoilt = light_field(grid=(4, 5), aligned_px=ALIGNED_PX)
    spoilt[1, 2] = np.ascontiguousarray(spoilt[1, 2][::-1, ::-1])
    spoilt[3, 4] = np.roll(spoilt[3, 4], 11, axis=0)
    spoilt[0, 0] = light_field(CARDS, (1, 1), seed=99)[0, 0]
    result = inspect(spoilt)
    assert [sorted(spoilt)[index] for index in result.fits.odd] == [(0, 0), (1, 2), (3, 4)]
    assert result.orientation == Orientation()


def test_copies_and_different_light_are_measured(aligned: Views) -> None:
    nodes = sorted(aligned)
    views = {**aligned, (2, 2): aligned[0, 1], (1, 3): aligned[1, 3] * np.float32(1.5)}
    pictures = prepare_pictures(views[node] for node in nodes)
    assert pictures.copies() == [(nodes.index((0, 1)), nodes.index((2, 2)))]
    assert pictures.relative_light[nodes.index((1, 3))] == pytest.approx(1.5, rel=0.1)
    assert inspect_grid(nodes, pictures).orientation == Orientation()


def test_missing_views_change_nothing(aligned: Views) -> None:
    misnamed = _misnamed(aligned, Orientation(flip_columns=True))
    result = inspect({node: picture for node, picture in misnamed.items() if sum(node) % 4})
    assert (result.orientation, result.direction) == (Orientation(flip_columns=True), "pictures")


def test_turned_and_shifted_views_are_measured() -> None:
    views = light_field(grid=(5, 6), aligned_px=ALIGNED_PX)
    turned, shifted = (sorted(views).index(node) for node in ((2, 3), (1, 1)))
    turn = cv2.getRotationMatrix2D((79.5, 59.5), -2.0, 1.0)  # clockwise as seen, from x towards y
    views[2, 3] = cv2.warpAffine(views[2, 3], turn, (160, 120), borderMode=cv2.BORDER_REFLECT).astype(np.float32)
    views[1, 1] = np.roll(views[1, 1], 2, axis=0)
    result = inspect(views)
    assert np.degrees(result.fits.turn_rad[turned]) == pytest.approx(2.0, abs=0.3)
    assert np.abs(np.delete(np.degrees(result.fits.turn_rad), turned)).max() < 0.3
    assert result.fits.shift_px[shifted] == pytest.approx([0.0, 2.0], abs=0.4)


def _small(grid: tuple[int, int], seed: int = 21) -> Views:
    return light_field(CARDS, grid=grid, size_px=(128, 96), aligned_px=ALIGNED_PX, seed=seed)


@pytest.mark.parametrize(
    ("grid", "snr", "seed"), [((3, 4), np.inf, 0), pytest.param((1, 9), 3.0, 2, marks=pytest.mark.deep)]
)
def test_neighbours_fit_unless_shuffled(grid: tuple[int, int], snr: float, seed: int) -> None:
    views = with_noise(_small(grid), snr)
    ordered = inspect(views)
    assert (ordered.order.verdict, ordered.still) == ("fits", False)
    order, pictures = np.random.default_rng(seed).permutation(len(views)), list(views.values())
    shuffled = {node: pictures[index] for node, index in zip(views, order, strict=True)}
    assert inspect(shuffled).order.verdict == "denied"


def test_line_of_views_is_no_square() -> None:
    line = _small((1, 9), seed=22)
    assert inspect({divmod(place, 3): view for (_, place), view in line.items()}).order.verdict == "denied"


def test_copies_with_noise_fit_anywhere() -> None:
    result = inspect(with_noise(dict.fromkeys(np.ndindex(3, 3), _small((1, 1))[0, 0]), 50))
    assert (result.failure, result.order.verdict, result.still) == (None, "open", True)


@pytest.mark.parametrize(("grid", "snr", "seed"), [((3, 4), 0.16, 0), ((1, 9), 1.0, 2)])
@pytest.mark.deep
def test_dark_views_keep_their_order(grid: tuple[int, int], snr: float, seed: int) -> None:
    result = inspect(with_noise(_small(grid), snr, seed))
    assert result.order.verdict in ("open", "few", "fits")
    assert (result.orientation, result.undecided, result.fits.odd) == (Orientation(), False, [])


@pytest.mark.parametrize("grid", [(1, 2), (2, 2)], ids=str)
def test_up_to_four_views_are_too_few(grid: tuple[int, int]) -> None:
    assert inspect(light_field(CARDS, grid=grid, size_px=(128, 96))).order.verdict == "few"


def test_small_disparities_count_in_pixels_of_files() -> None:
    """Pictures above 448 px are halved, and so are disparities: 0.4 px of the files are 0.2 px there."""
    result = inspect(light_field((Layer(-0.4),), grid=(3, 3), size_px=(460, 80)))
    assert (result.direction, result.aligned, result.still) == ("signs", False, False)


def test_few_wrong_blocks_do_not_widen_the_range() -> None:
    shifts_px = np.arange(-3, 3.01, 0.1)
    moved_px = np.repeat([-2.0, 2.0], [298, 2])
    scores = np.array(1 - (shifts_px - moved_px[:, np.newaxis]) ** 2, np.float32)[np.newaxis]
    one_line = {(1, 0): scores}
    correlations = Correlations(shifts_px, one_line, {key: np.zeros_like(scores) for key in one_line})
    assert disparity_range(correlations, Axes()) == pytest.approx((-2.0, -2.0))


@pytest.mark.parametrize(("no_sign_px", "ratio"), [(0.125, 1.5), (0.25, 1.0)])
def test_blocks_for_the_ratio_must_agree(no_sign_px: float, ratio: float) -> None:
    """A pitch ratio of 1.5 from 13 blocks; 20 more are wrong by more than half of `no_sign_px` explains."""
    shifts_px = np.arange(-1, 1.01, 0.1)
    along_px = {(1, 0): np.array([0.6] * 13 + [0.4] * 20), (0, 1): np.full(33, 0.4)}
    scores = {
        key: np.array(1 - (shifts_px - px[:, np.newaxis]) ** 2, np.float32)[np.newaxis] for key, px in along_px.items()
    }
    chance = {key: np.zeros_like(score) for key, score in scores.items()}
    assert pitch_ratio(Correlations(shifts_px, scores, chance), Axes(ratio=1.5), no_sign_px) == pytest.approx(ratio)


def test_blocks_outside_the_other_view_are_ignored() -> None:
    generator = np.random.default_rng(3)
    view, other = generator.standard_normal((2, 120, 160)).astype(np.float32)
    other[:, :60] = view[:, 100:]
    pair = compare_pair(view, other, 0, (-102.0, -98.0))
    assert pair is not None
    assert pair.score > 0.99
