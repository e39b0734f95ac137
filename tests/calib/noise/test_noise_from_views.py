"""Gain and read noise from the views of a scene, against the truth of simulated ones."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.errors import NotIdentifiable
from faintfield.calib.noise.noise_from_views import ViewBlocks, ViewNoise, compared_blocks, estimate_view_noise

type Array = NDArray[np.float64]

_SHAPE, _MARGIN = (320, 448), 32

# Views (row, column) that are compared, the middle one second: across, down, and around a corner.
_THREES = (((1, 0), (1, 1), (1, 2)), ((0, 1), (1, 1), (2, 1)), ((0, 0), (0, 1), (1, 0)), ((2, 2), (2, 1), (1, 2)))


def _texture(rng: np.random.Generator) -> Array:
    """Return texture within 0 and 1 with detail at all scales down to 4 px."""
    shape = tuple(side + 2 * _MARGIN for side in _SHAPE)
    frequency = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1]))
    frequency[0, 0] = np.inf
    power = frequency**-1.5 * np.exp(-((frequency / 0.25) ** 4))
    field = np.fft.irfft2(power * np.exp(2j * np.pi * rng.random(power.shape)), s=shape)
    return np.asarray((field - field.min()) / np.ptp(field))


def _moved(field: Array, down: float, right: float) -> Array:
    """Return a periodic field moved by parts of a pixel, exactly."""
    phase = np.fft.fftfreq(field.shape[0])[:, None] * down + np.fft.rfftfreq(field.shape[1]) * right
    return np.asarray(np.fft.irfft2(np.fft.rfft2(field) * np.exp(-2j * np.pi * phase), s=field.shape))


@cache
def _scene() -> dict[tuple[int, int], Array]:
    """Return a textured wall behind five textured discs, each at its own depth, seen by 3 x 3 cameras; light 0 to 1."""
    rng = np.random.default_rng(3)
    layers = [(0.63, np.ones(()), _texture(rng) ** 2)]
    y, x = np.indices(layers[0][2].shape)
    for disparity_px in np.sort(rng.uniform(1, 4, 5)):
        centre, radius = rng.random(2) * y.shape, rng.uniform(40, 90)
        disc = 1 / (1 + np.exp(np.clip((np.hypot(y - centre[0], x - centre[1]) - radius) / 0.5, -50, 50)))
        layers.append((disparity_px, disc, _texture(rng) * rng.uniform(0.02, 1)))
    views = {}
    for row, column in np.ndindex(3, 3):
        picture = np.zeros(y.shape)
        for disparity_px, opaque, light in layers:
            by = (-disparity_px * (row - 1), -disparity_px * (column - 1))
            cover = np.clip(_moved(opaque, *by), 0, 1) if opaque.ndim else 1.0
            picture = picture * (1 - cover) + cover * _moved(light, *by)
        views[row, column] = np.clip(picture[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN], 0, 1)
    return views


def _rounding(mean_dn: Array) -> Array:
    return np.full_like(mean_dn, 1 / 12)


def _blocks(frames: dict[tuple[int, int], Any], saturation_dn: float, floor_dn: float) -> list[ViewBlocks]:
    rng = np.random.default_rng(1)
    return [
        compared_blocks(
            _views([frames[node] for node in three]), saturation_dn=saturation_dn, floor_dn=floor_dn, generator=rng
        )
        for three in _THREES
    ]


def _views(pictures: Sequence[NDArray[Any]]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    first, middle, last = (np.asarray(picture, np.float32)[:, :, None] for picture in pictures)
    return first, middle, last


def _exposed(views: dict[tuple[int, int], Array], full_e: float, read_e: float) -> dict[tuple[int, int], Array]:
    """Return noisy electrons."""
    rng = np.random.default_rng(5)
    return {node: rng.poisson(view * full_e) + rng.normal(0, read_e, view.shape) for node, view in views.items()}


def _linear(gain: float, gain_dn: float | None = None) -> tuple[ViewNoise, float]:
    """Return the noise estimated of a linear sensor, and its read noise in e, a seventh of the noise of white."""
    full_e = min(50_000 / gain, 20_000.0)
    read_e = float(np.sqrt(0.02 * full_e))
    offset_dn = round(8 * read_e * gain) + 5
    frames = {
        node: np.clip(np.rint(offset_dn + gain * electrons), 0, 65535) - offset_dn
        for node, electrons in _exposed(_scene(), full_e, read_e).items()
    }
    blocks = _blocks(frames, 65535 - offset_dn, -offset_dn)
    return estimate_view_noise(blocks, least_variance_dn2=_rounding, gain_dn=gain_dn), read_e


@pytest.mark.parametrize("gain", [0.1, 10.0])
def test_gain_and_read_noise_under_texture(gain: float) -> None:
    noise, read_e = _linear(gain)
    assert noise.gain_dn.value == pytest.approx(gain, rel=0.15)
    assert np.sqrt((noise.read_noise_dn.value or 0.0) ** 2 - 1 / 12) / gain == pytest.approx(read_e, rel=0.2)
    for estimate in (noise.gain_dn, noise.read_noise_dn):
        value, (low, high) = estimate.value or 0.0, estimate.ci95 or (0.0, 0.0)
        assert low <= value <= high
        assert 0 < high - low < value
    np.testing.assert_allclose(noise.variance_dn2, gain * noise.mean_dn + (gain * read_e) ** 2, rtol=0.25)


def test_known_gain_leaves_the_read_noise() -> None:
    noise, read_e = _linear(2.0, gain_dn=2.0)
    assert noise.gain_dn.ci95 == pytest.approx((2.0, 2.0), rel=1e-12)
    assert (noise.read_noise_dn.value or 0.0) / 2.0 == pytest.approx(read_e, rel=0.1)


def _encoded(light: Array) -> NDArray[np.uint8]:
    """Return light by the equations of IEC 61966-2-1 as 8-bit values."""
    light = np.clip(light, 0, 1)
    return np.asarray(np.rint(255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)))


def _decoded(values: NDArray[Any]) -> Array:
    value = values / 255
    return np.asarray(65535 * np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4))


@pytest.mark.parametrize(
    ("full_e", "read_e", "quality"),
    [(500, 5, None), pytest.param(60_000, 30, None, marks=pytest.mark.deep), (2000, 10, 90)],
    ids=["few electrons", "near the rounding", "JPEG"],
)
def test_variance_of_encoded_pictures_is_predicted(full_e: float, read_e: float, quality: int | None) -> None:
    truth = {node: 0.01 + 0.85 * view for node, view in _scene().items()}
    frames = {}
    for node, electrons in _exposed(truth, full_e, read_e).items():
        values = _encoded(electrons / full_e).astype(np.uint8)
        if quality is not None:
            _, content = cv2.imencode(".jpg", values, [cv2.IMWRITE_JPEG_QUALITY, quality])
            values = np.asarray(cv2.imdecode(content, cv2.IMREAD_UNCHANGED))
        frames[node] = _decoded(values)

    def steps_dn2(mean_dn: Array) -> Array:
        return np.interp(mean_dn, _decoded(np.arange(256)), np.gradient(_decoded(np.arange(256)))) ** 2 / 12

    share = 0.3 if quality is None else 1.0
    noise = estimate_view_noise(_blocks(frames, 65535, 0), least_variance_dn2=steps_dn2, flattest=share)
    light = np.concatenate([view.ravel() for view in truth.values()])
    error_dn = np.concatenate([(frames[node] - 65535 * view).ravel() for node, view in truth.items()])
    gain_dn, read_dn = noise.gain_dn.value or 0.0, noise.read_noise_dn.value or 0.0
    for level in (0.03, 0.1, 0.3, 0.6, 0.8):
        variance_dn2 = np.mean(error_dn[np.abs(light / level - 1) < 0.1] ** 2)
        predicted_dn2 = gain_dn * level * 65535 + read_dn**2
        assert predicted_dn2 == pytest.approx(variance_dn2, rel=0.25), level


@pytest.mark.parametrize(("by_px", "brighter"), [(0, 0.0), (3, 30.0)])
def test_whole_pixels_and_brightness_are_explained(by_px: int, brighter: float) -> None:
    middle, rng = 1000 * _scene()[1, 1], np.random.default_rng(8)
    pictures = [
        np.roll(middle, by * by_px, axis=1) + rng.normal(0, 5, middle.shape) + brighter * by for by in (-1, 0, 1)
    ]
    blocks = compared_blocks(_views(pictures), saturation_dn=1e9, floor_dn=-1e9, generator=rng)
    assert np.median(blocks.variance_dn2) == pytest.approx(25, rel=0.05)


def test_saturated_and_cut_off_blocks_do_not_count() -> None:
    rng = np.random.default_rng(9)
    pictures = np.full((160, 160), 100.0) + rng.normal(0, 3, (3, 160, 160))
    pictures[:, :80] += 900  # saturated at 1000
    pictures[:, :, :80] -= 99  # dark on the left
    views = _views(list(np.clip(pictures, 0, 1000)))
    blocks = compared_blocks(views, saturation_dn=1000, floor_dn=0, generator=rng)
    assert set(np.unique(np.round(blocks.mean_dn / 100))) & {0, 1, 9, 10} == {1, 9}


@pytest.mark.parametrize("shape", [(20, 400), (160, 160)], ids=["too small", "of one brightness"])
def test_views_without_noise_over_light_are_refused(shape: tuple[int, int]) -> None:
    views = _views([np.full(shape, 50)] * 3)
    blocks = compared_blocks(views, saturation_dn=255, floor_dn=0, generator=np.random.default_rng(2))
    with pytest.raises(NotIdentifiable, match="points of variance against light, 3 are needed"):
        estimate_view_noise([blocks], least_variance_dn2=_rounding)
    with pytest.raises(NotIdentifiable, match="0 blocks of 16 x 16 px"):
        estimate_view_noise([], least_variance_dn2=_rounding)
