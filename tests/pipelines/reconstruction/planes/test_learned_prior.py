"""The network for planes: its numbers, its tiles, what it does with noise alone, and when it should not be asked."""

from importlib import resources
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.reconstruction.planes import learned_prior
from faintfield.pipelines.reconstruction.planes.learned_prior import learned_estimate, network_input, outside_range
from faintfield.pipelines.reconstruction.planes.solve import solve
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.prior.collaborative import Patches, collaborative_wiener
from faintfield.recon.prior.evidence import Noise, noise_of_back_projection
from faintfield.recon.solver.initialization import back_projection
from tests.recon.displaced import views_displaced_by

_FILE = resources.files("faintfield.pipelines.reconstruction.planes") / "networks" / "plane_prior.onnx"

# By training/reference.py, sums in numpy for waves.
_VALUES = {(0, 0): -0.050578, (3, 5): 0.375013, (11, 15): 0.026569, (23, 8): 0.191935}
_ROOT_MEAN_SQUARE = 0.236324


class Known(NamedTuple):
    """Inputs of the network for a dark plane, and its true light as blurred as the back-projection."""

    picture: Image
    pilot: Image
    patches: Image
    noise: Noise
    truth: Image

    def estimate(self) -> NDArray[np.float32]:
        return learned_estimate(self.picture, self.pilot, self.patches, self.noise.variance)


def known_of(light_e: Image, seed: int, views: int = 25, read_noise_e: float = 3.0) -> Known:
    """Expose views of a plane, displaced by fractions of a pixel, and reconstruct it as the product does."""
    random = np.random.default_rng(seed)
    operator = views_displaced_by(random.uniform(-1.5, 0.5, (views, 2)), light_e.shape)
    light = operator.forward(light_e.astype(np.float32))
    electrons = random.poisson(light) + random.normal(0, read_noise_e, light.shape)
    images = ElementalImages(electrons.astype(np.float32), 0.0, read_noise_e**2)
    plane = solve(operator, images, "pmlem", SolverOptions(penalty_weight=0.9 * views**0.5 / read_noise_e)).plane
    noise = noise_of_back_projection(operator, images, plane)
    pilot, picture = operator.adjoint_of_forward(plane) / operator.coverage(), back_projection(operator, images)
    patches = collaborative_wiener(picture, pilot, noise, Patches(8, 4, 16, 64))
    return Known(picture, pilot, patches, noise, back_projection(operator, ElementalImages(light)))


def made_up(shape: tuple[int, int], seed: int = 2) -> tuple[Image, Image, Image, Image]:
    """Return smooth pictures with noise and a variance: arguments of `learned_estimate`."""
    random = np.random.default_rng(seed)
    patches = 2 + np.cos(np.arange(shape[0])[:, np.newaxis] / 9) * np.sin(np.arange(shape[1]) / 7)
    variance = np.full(shape, 0.25) * (1 + 0.3 * patches)
    y = patches + random.normal(size=shape) * np.sqrt(variance)
    return y, patches + 0.1 * random.normal(size=shape), patches, variance


def test_network_equals_sums_and_estimate_its_mean() -> None:
    network = cv2.dnn.readNetFromONNX(np.frombuffer(_FILE.read_bytes(), np.uint8))
    phase = np.arange(24)[:, np.newaxis] * 0.7 + np.arange(16) * 0.4
    network.setInput(np.stack([np.sin(phase * (k + 1)) + 0.1 * k for k in range(4)]).astype(np.float32)[np.newaxis])
    output = network.forward()[0, 0]
    assert np.sqrt(np.mean(np.square(output))) == pytest.approx(_ROOT_MEAN_SQUARE, abs=1e-4)
    for at, value in _VALUES.items():
        assert output[at] == pytest.approx(value, abs=1e-4)
    # The estimate is the mean over two turns
    y, u, p, v = made_up((16, 24))
    inputs, deviation = network_input(y, u, p, v)
    change = np.zeros(p.shape)
    for turn in range(2):
        network.setInput(np.ascontiguousarray(np.rot90(inputs, turn, (1, 2)))[np.newaxis])
        change += np.rot90(network.forward()[0, 0], -turn) / 2
    np.testing.assert_allclose(learned_estimate(y, u, p, v), p + deviation * change, atol=1e-5)
    assert change.std() > 0.01


@pytest.mark.parametrize("shape", [(8, 8), (41, 67)])
def test_planes_are_padded_by_mirror_images(shape: tuple[int, int]) -> None:
    y, u, p, _ = made_up(shape)
    more = [(0, -length % 8) for length in shape]
    more_y, more_u, more_p = (np.pad(array, more, mode="symmetric") for array in (y, u, p))
    found = learned_estimate(y, u, p, np.full(shape, 0.3))
    wanted = learned_estimate(more_y, more_u, more_p, np.full(more_p.shape, 0.3))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, wanted[: shape[0], : shape[1]], atol=1e-5)


def test_tiles_join_without_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    known = made_up((136, 120))
    whole = learned_estimate(*known)
    monkeypatch.setattr(learned_prior, "_TILE", 64)
    assert np.abs(learned_estimate(*known) - whole).max() < 1e-3 * np.sqrt(known[-1].min())
    monkeypatch.setattr(learned_prior, "_MARGIN", 0)
    assert np.abs(learned_estimate(*known) - whole).max() > 1e-2 * np.sqrt(known[-1].min())


def test_network_sees_light_in_units_of_noise() -> None:
    y, u, p, v = made_up((16, 16))
    inputs, deviation = network_input(y, u, p, v)
    np.testing.assert_allclose(deviation, np.sqrt(v), rtol=1e-6)
    np.testing.assert_allclose(p + inputs[0] * np.sqrt(v), y, atol=1e-6)
    np.testing.assert_allclose(p + inputs[1] * np.sqrt(v), u, atol=1e-6)
    np.testing.assert_allclose(8 * inputs[2] * np.sqrt(v), p, atol=1e-6)
    np.testing.assert_allclose(np.exp(inputs[3]) * np.median(np.sqrt(v)), np.sqrt(v), rtol=1e-5)


def test_unseen_samples_keep_patches_and_disturb_no_others() -> None:
    y, u, p, v = made_up((64, 80))
    v[:, 60:] = np.inf
    found = learned_estimate(y, u, p, v)
    np.testing.assert_array_equal(found[:, 60:], p[:, 60:].astype(np.float32))
    y[:, 60:] = u[:, 60:] = np.nan
    np.testing.assert_array_equal(learned_estimate(y, u, p, v), found)


def errors(known: Known, picture: Image) -> Image:
    """Return the errors of a picture in units of the noise, away from the edges."""
    return ((picture - known.truth) / np.sqrt(known.noise.variance))[4:-4, 4:-4]


@pytest.mark.parametrize("level_e", [0.01, 8.0])
def test_plain_fields_come_out_plain(level_e: float) -> None:
    known = known_of(np.full((72, 80), level_e), seed=3)
    left = errors(known, known.estimate())
    assert np.abs(left).max() < 0.5
    assert left.std() < 0.1
    assert left.std() < errors(known, known.patches).std()


def lettered(shape: tuple[int, int] = (96, 128)) -> Image:
    canvas = np.zeros(shape, np.uint8)
    cv2.rectangle(canvas, (12, 14), (110, 84), 120, -1)
    cv2.putText(canvas, "R7k", (20, 66), cv2.FONT_HERSHEY_DUPLEX, 1.6, 255, 3, cv2.LINE_AA)
    return np.asarray(cv2.GaussianBlur(canvas, (0, 0), 0.7) / 255 * 4.0)


def test_picture_comes_nearer_to_truth() -> None:
    known = known_of(lettered(), seed=5)
    before, after = (float(np.mean(np.square(x - known.truth))) for x in (known.patches, known.estimate()))
    assert after < 0.85 * before


def known_noise(shape: tuple[int, int] = (64, 64)) -> Noise:
    return Noise(np.full(shape, 0.25, np.float32), np.outer([0.25, 1, 0.25], [0.25, 1, 0.25]))


@pytest.mark.parametrize(
    ("light_e", "noise", "message"),
    [
        (1.0, known_noise(), ""),
        (500.0, known_noise(), "times its noise"),
        (1.0, known_noise((16, 64)), "samples"),
        (1.0, known_noise()._replace(kernel=np.full((3, 3), 0.6)), "neighbours"),
        (1.0, known_noise()._replace(variance=np.full((64, 64), np.inf, np.float32)), "seen"),
        (1.0, known_noise()._replace(variance=np.tile(np.geomspace(1e-3, 1e3, 64, dtype="f4"), (64, 1))), "its median"),
    ],
)
def test_what_it_was_not_trained_for_is_named(light_e: float, noise: Noise, message: str) -> None:
    reason = outside_range(np.full(noise.variance.shape, light_e), noise) or ""
    assert message in reason
    assert bool(reason) == bool(message)
