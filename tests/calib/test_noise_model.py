"""Digital numbers to electrons, against closed forms."""

from typing import Any

import numpy as np
import pytest

from faintfield.calib.noise_model import NoiseModel

GOOD: dict[str, Any] = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0}


@pytest.mark.parametrize(
    ("offset_dn", "gain_dn_per_e"),
    [(100.0, 2.0), (np.array([[90.0, 100.5, 110]]), np.array([[1.9, 2.0, 2.3]]))],
    ids=["numbers", "maps"],
)
def test_electrons_undo_offset_and_gain(offset_dn: Any, gain_dn_per_e: Any) -> None:
    model = NoiseModel(offset_dn, gain_dn_per_e, read_noise_e=3.0)
    frame_dn = np.array([[0, 101, 65535], [99, 100, 7]], np.uint16)
    electrons = model.electrons(frame_dn)
    assert electrons.dtype == np.float32
    assert electrons[0, 0] < 0
    np.testing.assert_allclose(electrons, (frame_dn.astype(float) - offset_dn) / gain_dn_per_e, rtol=1e-6)


def test_read_variance_includes_rounding() -> None:
    generator = np.random.default_rng(20110919)
    model = NoiseModel(1000.0, 0.8, read_noise_e=1.5)
    frame_dn = np.rint(1000.0 + 0.8 * generator.normal(0, 1.5, 10**6))
    assert model.read_variance_e2() == pytest.approx(1.5**2 + 1 / (12 * 0.8**2))
    # A variance of a million normal numbers is known to √2 / 1000 of itself; rounding alone is 6 % of it
    assert model.electrons(frame_dn).var(dtype=float) == pytest.approx(model.read_variance_e2(), rel=4 * 1.5e-3)


def test_dark_electrons_grow_with_the_exposure() -> None:
    dark_current = np.array([[0.2, 3.0]])
    model = NoiseModel(**GOOD, dark_current_e_per_s=dark_current)
    np.testing.assert_allclose(model.background_e(0.1), [[0.02, 0.3]])
    assert NoiseModel(**GOOD).background_e(10.0) == 0.0


@pytest.mark.parametrize("saturation_dn", [1000.0, 1000.5, 70_000.0, np.inf])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float64])
def test_pixels_at_the_saturation_level_are_saturated(saturation_dn: float, dtype: type[Any]) -> None:
    frame_dn = np.array([[0, 3, 255], [999, 1000, 1001]]).astype(dtype)
    expected = frame_dn.astype(float) >= saturation_dn
    np.testing.assert_array_equal(NoiseModel(**GOOD, saturation_dn=saturation_dn).saturated(frame_dn), expected)


def test_electrons_are_written_into_a_stack() -> None:
    """Also of a part of an array, and of more rows than are converted at a time."""
    model, frame_dn = NoiseModel(**GOOD), np.arange(201 * 6).reshape(201, 6).astype(np.uint16)
    stack = np.full((3, 201, 3), np.nan, np.float32)
    assert model.electrons(frame_dn[:, ::2], stack[1]) is not None
    np.testing.assert_array_equal(stack[1], (frame_dn[:, ::2].astype(np.float32) - 100) / 2)
    assert np.isnan(stack[[0, 2]]).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("offset_dn", np.array([[100.0, np.inf]])),
        ("gain_dn_per_e", np.array([[2.0, -2.0]])),
        ("read_noise_e", -1.0),
        ("dark_current_e_per_s", -0.1),
        ("quantum_efficiency", 1.1),
        ("saturation_dn", np.nan),
    ],
)
def test_invalid_sensor_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        NoiseModel(**{**GOOD, name: value})
