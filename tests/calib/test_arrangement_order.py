"""Whether neighbours by their names are neighbours, and disparities near zero, against scenes whose order is known."""

import numpy as np
import pytest

from faintfield.calib.arrangement import fitting_views, scene
from faintfield.calib.arrangement.look import Look, look
from faintfield.calib.arrangement.matching import Tables
from tests.calib.light_fields import CARDS, Layer, Views, light_field, with_noise


def _seen(views: Views) -> Look:
    nodes = sorted(views)
    return look(nodes, lambda index: views[nodes[index]])


def _shuffled(views: Views, seed: int) -> Views:
    order = np.random.default_rng(seed).permutation(len(views))
    pictures = list(views.values())
    return {node: pictures[index] for node, index in zip(views, order, strict=True)}


@pytest.fixture(scope="module", params=[(3, 4), (1, 9)], ids=str)
def views(request: pytest.FixtureRequest) -> Views:
    return light_field(CARDS, grid=request.param, size_px=(128, 96), aligned_px=2.4, seed=21)


@pytest.mark.parametrize(("snr", "seed"), [(np.inf, 0), (3.0, 2)])
def test_neighbours_in_order_fit_and_in_random_order_do_not(snr: float, seed: int, views: Views) -> None:
    noisy = with_noise(views, snr)
    assert _seen(noisy).order.verdict == "fits"
    assert _seen(_shuffled(noisy, seed)).order.verdict == "denied"


def test_a_line_of_views_is_no_square() -> None:
    line = light_field(CARDS, grid=(1, 9), size_px=(128, 96), seed=22)
    assert _seen({divmod(place, 3): view for (_, place), view in line.items()}).order.verdict == "denied"


def test_copies_with_noise_fit_in_every_place(views: Views) -> None:
    found = _seen(with_noise(dict.fromkeys(views, next(iter(views.values()))), 50))
    assert found.seen
    assert found.order.verdict == "open"
    assert found.still
    assert not _seen(views).still


@pytest.mark.parametrize(("snr", "seed"), [(0.16, 0), (1.0, 2)])
def test_the_order_of_dark_views_is_never_denied(snr: float, seed: int, views: Views) -> None:
    assert _seen(with_noise(views, snr, seed)).order.verdict in ("open", "few", "fits")


@pytest.mark.parametrize("size", [(1, 2), (2, 2)], ids=str)
def test_two_to_four_views_have_too_few_others_to_compare(size: tuple[int, int]) -> None:
    assert _seen(light_field(CARDS, grid=size, size_px=(128, 96))).order.verdict == "few"


def test_what_has_no_sign_is_counted_in_pixels_of_the_files() -> None:
    """Pictures above 448 px are halved, and so are disparities: 0.4 px of the files are 0.2 px there."""
    found = _seen(light_field((Layer(-0.4),), grid=(5, 5), size_px=(460, 120)))
    assert (found.direction, found.aligned, found.still) == ("signs", False, False)


def test_blocks_count_for_the_ratio_only_if_they_agree_with_it_beyond_what_has_no_sign() -> None:
    """A pitch ratio of 1.5 from 13 blocks; 20 more are wrong by more than half of `no_sign_px` explains."""
    shifts_px = np.arange(-1, 1.01, 0.1)
    x_px, y_px = np.array([0.6] * 13 + [0.4] * 20), np.full(33, 0.4)
    along = {
        key: np.array(1 - (shifts_px - moved[:, np.newaxis]) ** 2, np.float32)[np.newaxis]
        for key, moved in (((1, 0), x_px), ((0, 1), y_px))
    }
    tables = Tables(shifts_px, along, (3, 11))
    chance = Tables(shifts_px, {key: np.zeros_like(table) for key, table in along.items()}, (3, 11))
    assert scene.pitch_ratio(tables, chance, 1.5, 0.125)[0] == pytest.approx(1.5)
    assert scene.pitch_ratio(tables, chance, 1.5, 0.25)[0] == 1.0


def test_blocks_that_left_the_other_view_are_not_looked_for_elsewhere() -> None:
    generator = np.random.default_rng(3)
    view, other = generator.standard_normal((2, 120, 160)).astype(np.float32)
    other[:, :60] = view[:, 100:]
    pair = fitting_views.compare_pair({(0, 0): view, (0, 1): other}, (0, 0), (0, 1), 0, (-102.0, -98.0))
    assert pair.score > 0.99
