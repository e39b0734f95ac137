"""Evidence of depths, the range and steps of the search, and predictions of views that were left out."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from faintfield.recon.errors import NothingInFocus
from faintfield.recon.surface.confidence import RIGHT_WITHIN
from faintfield.recon.surface.estimate import equal_steps, found_range, halves
from faintfield.recon.surface.evidence import DepthEvidence
from faintfield.recon.surface.goodness import predicted, seen_of, squared_errors
from faintfield.recon.surface.pinhole_views import UNKNOWN, PinholeViews
from tests.recon import surface_scene
from tests.recon.surface_scene import DEPTHS, FAR, FARTHEST, LEVEL_E, NEAR, NEAREST, NODES, SHAPE

LEFT_OUT = np.array([1, 8, 12, 15, 23])


@pytest.mark.parametrize(
    ("nodes", "first"),
    [
        ([(row, column) for row in range(3) for column in range(3)], [0, 2, 4, 6, 8]),  # a checkerboard
        ([(row, column) for row in (0, 2, 4) for column in (1, 3, 5)], [0, 2, 4, 6, 8]),  # every second node
        ([(k, k) for k in range(6)], [0, 2, 4]),  # along a diagonal
        ([(0, 1), (1, 0), (1, 1), (1, 2), (2, 1)], [0, 2, 4]),  # a cross
        ([(0, k) for k in (0, 1, 3, 4, 5)], [0, 3]),  # by node, not by number
    ],
)
def test_both_halves_have_views_however_nodes_lie(nodes: list[tuple[int, int]], first: list[int]) -> None:
    both = halves(np.array(nodes))
    assert both.first.tolist() == first
    assert both.second.tolist() == sorted({*range(len(nodes))} - {*first})


def test_darkness_without_noise_is_no_evidence() -> None:
    """Pixels that never count a photon have no variance: a division by it would spoil the samples around them."""
    light = surface_scene.expected_light(LEVEL_E).astype(np.float32)
    light[:, :, 20:] = 0
    ratios = _evidence(replace(surface_scene.views_of(light), variance_e2=0.0)).at_first()
    assert np.isfinite(ratios).all()
    assert np.ptp(ratios[20:40, 5:15], axis=2).max() > 1


def test_steps_are_as_fine_as_outermost_view_needs() -> None:
    views = surface_scene.drawn_views(LEVEL_E)
    outermost = max(np.hypot(*surface_scene.CENTRES_MM.T)) * surface_scene.FOCAL_PX  # samples per 1/depth
    for near in (NEAREST, 1 / 120):
        depths = equal_steps(views, FARTHEST, near)
        np.testing.assert_allclose(np.diff(depths), (near - FARTHEST) / (len(depths) - 1), rtol=1e-9)
        assert (depths[0], depths[-1]) == (FARTHEST, pytest.approx(near))
    moved = outermost * np.diff(depths)[0]
    assert 1.4 < moved <= 1.6
    assert len(equal_steps(views, FARTHEST, FARTHEST * 1.01)) == 64
    assert len(equal_steps(views, FARTHEST, 1.0)) == 128


@pytest.mark.parametrize(("farthest", "nearest"), [(1 / 1000, 1 / 380), (1 / 602, 1 / 498)])
def test_range_contains_the_scene_and_little_more(farthest: float, nearest: float) -> None:
    far, near = found_range(surface_scene.drawn_views(LEVEL_E), farthest, nearest)
    assert farthest <= far < FAR < NEAR < near <= nearest
    assert near - far < 2 * (NEAR - FAR)


def test_noise_alone_has_no_range() -> None:
    views = surface_scene.noisy_views_of(np.full((25, *SHAPE), 5.0), 1)
    with pytest.raises(
        NothingInFocus,
        match=r"^depths are clear in [0-9.]+% of the picture, and must be in [0-9.]+%; use more light",
    ):
        found_range(views, 1 / 1000, 1 / 380)


def _evidence(views: PinholeViews) -> DepthEvidence:
    """Evidence of all views but those left out."""
    return DepthEvidence(views, DEPTHS, halves(NODES, np.setdiff1d(np.arange(25), LEFT_OUT)))


def _index_of(inverse_depth: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.interp(inverse_depth, DEPTHS, np.arange(len(DEPTHS)))


def test_right_surface_predicts_better_than_rivals() -> None:
    evidence = _evidence(surface_scene.drawn_views(LEVEL_E))
    kept = np.concatenate(evidence.halves)
    neighbours = [kept[np.abs(NODES[kept] - NODES[view]).sum(axis=1) == 1] for view in LEFT_OUT]
    right = predicted(evidence, _index_of(surface_scene.inverse_depth()), LEFT_OUT, neighbours)
    wrong = predicted(evidence, _index_of(np.full(SHAPE, FAR)), LEFT_OUT, neighbours)
    assert right.neighbours is not None
    assert 0.95 < right.surface < 1.4  # noise, and the cost of smoothing the light
    assert right.surface < 0.8 * wrong.surface
    assert right.surface < 0.8 * right.neighbours
    assert wrong.planes == pytest.approx(wrong.surface)  # a plane is one already
    assert right.views.tolist() == LEFT_OUT.tolist()
    size = len(LEFT_OUT) * SHAPE[0] * SHAPE[1]
    assert 0.75 * size < right.pixels < size
    assert predicted(evidence, _index_of(np.full(SHAPE, FAR)), LEFT_OUT, []).neighbours is None


def test_neighbours_predict_faint_light_without_bias() -> None:
    """Light of 2 e⁻ everywhere, of which neighbours show a third as unknown: the noise is the only error."""
    generator = np.random.default_rng(4)
    light = 2.0 + generator.normal(0, 2.0, (25, *SHAPE))
    light[generator.random(light.shape) < 1 / 3] = UNKNOWN
    neighbours = [np.setdiff1d(np.arange(25), LEFT_OUT)[:4]] * len(LEFT_OUT)
    far = _index_of(np.full(SHAPE, FAR))
    prediction = predicted(_evidence(surface_scene.views_of(light)), far, LEFT_OUT, neighbours)
    assert prediction.neighbours == pytest.approx(1, abs=0.03)
    light[LEFT_OUT] = UNKNOWN
    prediction = predicted(_evidence(surface_scene.views_of(light)), far, LEFT_OUT, [])
    assert prediction.pixels == 0
    assert np.isnan([prediction.surface, prediction.planes]).all()


@pytest.mark.parametrize("scale", [1.0, 1.2])
def test_deviance_of_the_truth_is_one(scale: float) -> None:
    """A prediction s times λ has (λ + σ² + ((s − 1) λ)²)/v on average, whatever it says of the variance v."""
    views = surface_scene.drawn_views(LEVEL_E)
    light = surface_scene.expected_light(LEVEL_E)[LEFT_OUT]
    variance = light + surface_scene.READ_VARIANCE_E2
    common = gaussian_filter(light, (0, 8, 8), mode="mirror") + surface_scene.READ_VARIANCE_E2
    mean = np.mean((variance + ((scale - 1) * light) ** 2) / common)
    result = squared_errors(_evidence(views), (scale * light).astype(np.float32), LEFT_OUT).mean()
    assert mean == pytest.approx(1, abs=0.05) or mean > 1.4
    assert result == pytest.approx(mean, abs=0.04)  # 4σ of 24 000 pixels


def test_deviance_counts_response_and_resampling() -> None:
    """Light between pixels, divided by a response: the truth still has a deviance of one."""
    generator, truth, response = np.random.default_rng(5), 30.0, np.linspace(0.4, 1, SHAPE[1], dtype=np.float32)
    counted = generator.normal(truth * response, np.sqrt(truth * response + 9), (25, SHAPE[0], SHAPE[1])) / response
    between = 0.7 * counted + 0.3 * np.roll(counted, 1, axis=1)
    views = replace(surface_scene.views_of(between), variance_e2=9.0, noise_share=0.7**2 + 0.3**2)
    views = replace(views, response=np.broadcast_to(response, SHAPE))
    result = squared_errors(_evidence(views), np.full((len(LEFT_OUT), *SHAPE), truth, np.float32), LEFT_OUT).mean()
    assert result == pytest.approx(1, abs=0.04)  # 4σ of 24 000 pixels


def test_only_pixels_between_samples_are_compared() -> None:
    """The outermost samples see no pixel beyond them: to expect one black there would decide all comparisons."""
    light = surface_scene.drawn_views(LEVEL_E).light_e.copy()
    light[LEFT_OUT[1], 20, 30] = UNKNOWN
    evidence = _evidence(surface_scene.views_of(light))
    masks = seen_of(evidence, evidence.explained(_index_of(np.full(SHAPE, FAR))), LEFT_OUT)
    row, column = np.indices(SHAPE)
    for view, mask in zip(LEFT_OUT, masks, strict=True):
        right, down = surface_scene.FOCAL_PX * surface_scene.CENTRES_MM[view] * (FAR - surface_scene.UNMOVED)
        inside = (row + down >= 0) & (row + down <= SHAPE[0] - 1) & (column + right >= 0)
        inside &= (column + right <= SHAPE[1] - 1) & (light[view] > UNKNOWN)
        assert (mask != inside).mean() < 0.02  # rounding, at the very border
        assert not mask[~inside].any()


def test_noise_of_halves_is_independent() -> None:
    """On average over depths and samples, noise speaks against any light: half of that light's own square."""
    noise = np.random.default_rng(1)
    light = 5 + noise.normal(0, 7**0.5, (25, *SHAPE))
    assert _evidence(surface_scene.views_of(light)).at_first().mean() < 0


@pytest.mark.parametrize("wrong", [FAR + NEAR - surface_scene.inverse_depth(), surface_scene.inverse_depth() + 4e-5])
def test_evidence_prefers_truth_to_wrong_surface(wrong: NDArray[np.float64]) -> None:
    """Against any surface, the depths of the truth have the larger log-likelihood: most where the surface is wrong."""
    evidence, truth = _evidence(surface_scene.drawn_views(LEVEL_E)), surface_scene.inverse_depth()
    ratios = evidence.against(evidence.explained(_index_of(wrong)))
    at, assumed = (np.rint(_index_of(depths)).astype(int)[..., np.newaxis] for depths in (truth, wrong))
    differ = surface_scene.away_from_edges(3) & (np.abs(wrong / truth - 1) > RIGHT_WITHIN)
    for volume in ratios:
        assert np.take_along_axis(volume, at, 2)[..., 0][differ].mean() > 0.05
    gained = np.take_along_axis(ratios.both, at, 2) - np.take_along_axis(ratios.both, assumed, 2)
    assert gained[..., 0][differ].mean() > 0.05
