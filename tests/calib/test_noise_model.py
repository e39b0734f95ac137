"""Digital numbers to electrons, against the simulated sensor and closed forms."""

from typing import Any

import numpy as np
import pytest

from faintfield.calib.noise_model import NoiseModel
from faintfield.rig.simulation.sensor import SimulatedSensor

GOOD: dict[str, Any] = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0}


@pytest.mark.parametrize(
    ("offset_dn", "gain_dn_per_e"),
    [(100.0, 2.0), (np.array([[90.0, 100.5, 110]]), np.array([[1.9, 2.0, 2.3]]))],
    ids=["numbers", "maps"],
)
def test_electrons_undo_offset_and_gain_and_may_be_negative(offset_dn: Any, gain_dn_per_e: Any) -> None:
    model = NoiseModel(offset_dn, gain_dn_per_e, read_noise_e=3.0)
    frame_dn = np.array([[0, 101, 65535], [99, 100, 7]], np.uint16)
    electrons = model.electrons(frame_dn)
    assert electrons.dtype == np.float32
    assert electrons[0, 0] < 0
    np.testing.assert_allclose(electrons, (frame_dn.astype(float) - offset_dn) / gain_dn_per_e, rtol=1e-6)


def test_electrons_of_the_simulated_sensor_come_back_within_its_rounding() -> None:
    electrons = np.linspace(-40, 30000, 1001).reshape(7, 143)
    frame_dn = SimulatedSensor(offset_dn=100.0, gain_dn_per_e=2.0).digitise(electrons)
    back = NoiseModel(100.0, 2.0, 3.0).electrons(frame_dn)
    np.testing.assert_allclose(back, electrons, rtol=0, atol=0.25 + 1e-3)


def test_the_read_variance_includes_rounding_to_whole_dn() -> None:
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


def test_pixels_at_or_above_the_saturation_level_are_saturated() -> None:
    model = NoiseModel(**GOOD, saturation_dn=65535)
    np.testing.assert_array_equal(model.saturated(np.array([[0, 65534, 65535]], np.uint16)), [[False, False, True]])
    assert not NoiseModel(**GOOD).saturated(np.array([[65535]], np.uint16)).any()


@pytest.mark.parametrize("saturation_dn", [1000.5, 70_000.0, np.inf])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float64])
def test_levels_between_whole_numbers_saturate_the_next(saturation_dn: float, dtype: type[Any]) -> None:
    frame_dn = np.array([[0, 3, 255], [999, 1000, 1001]]).astype(dtype)
    expected = frame_dn.astype(float) >= saturation_dn
    np.testing.assert_array_equal(NoiseModel(**GOOD, saturation_dn=saturation_dn).saturated(frame_dn), expected)


def test_electrons_are_written_where_they_are_wanted() -> None:
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
def test_invalid_sensors_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        NoiseModel(**{**GOOD, name: value})


def test_the_limits_themselves_are_allowed() -> None:
    model = NoiseModel(-5.0, 1e-3, 0.0, 0.0, quantum_efficiency=1.0)
    assert (model.offset_dn, model.gain_dn_per_e, model.quantum_efficiency) == (-5.0, 1e-3, 1.0)
