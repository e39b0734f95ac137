"""Where flats saturate, and which of them are left out, on simulated series with known ends."""

from dataclasses import replace

import numpy as np
import pytest

from faintfield.calib.errors import BadFrame, SaturatedFlat
from faintfield.calib.noise import Conditions, Series, calibrate, measure_series
from faintfield.calib.noise.series.flat_levels import check_flat_levels
from faintfield.calib.noise.series.saturation import find_saturation

OFFSET_DN, GAIN, READ_E = 50.0, 0.5, 6.0


def take(
    charges_e: list[float], frames: int = 2, ceiling_dn: float = 4095.0, well_e: float = np.inf, seed: int = 1
) -> list[Series]:
    """Take flats of these mean charges; wells differ by 3 % between pixels."""
    rng = np.random.default_rng(seed)
    well = well_e * (1 + 0.03 * rng.standard_normal((48, 48)))
    series = []
    for level, charge in enumerate(charges_e):
        kind = Conditions("flat" if charge else "dark", 0.1 * (1 + level) if not charge else 0.1, level, 2 * charge)
        taken = []
        for k in range(frames):
            electrons = np.minimum(rng.poisson(charge, well.shape), well) + rng.normal(0, READ_E, well.shape)
            dn = np.clip(np.rint(OFFSET_DN + GAIN * electrons), 0, ceiling_dn)
            taken.append((f"{charge:g} {k}", dn.astype(np.uint16)))
        series.append(measure_series(taken, kind))
    return series


DARKS = take([0.0, 0.0], 4, seed=2)


def test_levels_at_the_end_of_the_converter_are_left_out_though_nobody_states_it() -> None:
    flats = take([1000.0, 4000.0, 7600.0, 8020.0, 8300.0, 9000.0])
    found = find_saturation(DARKS, flats, np.inf)
    # 7600 e lie 5 standard deviations below the end, 8020 e one
    assert (found.limit, found.level_dn) == ("ADC", 4095.0)
    assert [one.conditions.level for one in found.kept] == [0, 1, 2]
    assert [one.conditions.level for one, _ in found.left_out] == [3, 4, 5]
    assert "stand at 4095 DN, the end of the range" in found.left_out[0][1]


def test_a_full_well_shows_in_noise_that_falls_and_ends_the_range_at_seven_tenths() -> None:
    charges = [500.0, 1000.0, 2000.0, 3000.0, 4000.0, 4500.0, 5000.0, 5500.0, 6000.0]
    flats = take(charges, well_e=5000.0)
    found = find_saturation(DARKS, flats, 4095.0)
    assert found.limit == "full well"
    assert found.level_dn == pytest.approx(OFFSET_DN + GAIN * 4500, rel=0.02)
    assert found.interval_dn is not None
    assert found.interval_dn[0] < OFFSET_DN + GAIN * 4700 < found.interval_dn[1]
    assert [one.conditions.level for one in found.kept] == [0, 1, 2, 3]


def test_flats_below_the_end_are_all_kept() -> None:
    flats = take([500.0, 2000.0, 5000.0])
    found = find_saturation(DARKS, flats, 4095.0)
    assert (found.limit, found.level_dn, found.interval_dn) == ("not reached", None, None)
    assert list(found.kept) == flats
    assert find_saturation(DARKS, [], np.inf).kept == ()


def test_flats_that_are_all_saturated_are_refused_by_name() -> None:
    with pytest.raises(SaturatedFlat, match=r"^8300 0: .* of the flat's pixels stand at 4095 DN"):
        find_saturation(DARKS, take([8300.0, 9000.0]), np.inf)


def test_the_capacity_is_the_charge_at_the_end() -> None:
    charges = [500.0, 2000.0, 3500.0, 5000.0, 6500.0, 7500.0, 9000.0]
    adc = calibrate([*DARKS, *take(charges)], 4095.0)
    capacity = adc.estimates["saturation_e"]
    assert capacity.ci95 is not None
    assert capacity.ci95[0] < (4095 - OFFSET_DN) / GAIN < capacity.ci95[1]
    assert capacity.value == pytest.approx((4095 - OFFSET_DN) / GAIN, rel=0.03)
    assert adc.noise_model().saturation_dn == 4095.0
    assert any(
        "1 series of flats are left out, beginning with the flats of 0.1 s at level 6" in warning
        for warning in adc.warnings
    )
    wells = [500.0, 1000.0, 2000.0, 3000.0, 4000.0, 4500.0, 5000.0, 5500.0]
    well = calibrate([*DARKS, *take(wells, well_e=5000.0)], 4095.0)
    capacity = well.estimates["saturation_e"]
    assert capacity.ci95 is not None
    assert capacity.ci95[0] < 4700 < capacity.ci95[1]
    assert well.estimates["gain_dn_per_e"].value == pytest.approx(GAIN, rel=0.03)


def test_one_series_of_too_much_noise_is_left_out_and_is_no_full_well() -> None:
    flats = take([1000.0, 2000.0, 3000.0, 4000.0, 5000.0, 6000.0])
    flats[2] = replace(flats[2], within_dn2=3 * flats[2].within_dn2)
    found = find_saturation(DARKS, flats, 4095.0)
    assert (found.limit, found.level_dn) == ("not reached", None)
    assert [one.conditions.level for one in found.kept] == [0, 1, 3, 4, 5]
    assert "the only one" in found.left_out[0][1]


def test_one_series_of_too_little_noise_gives_no_full_well_but_bright_flats_do_not_count() -> None:
    flats = take([1000.0, 2000.0, 3000.0, 4000.0, 5000.0, 6000.0])
    flats[5] = replace(flats[5], within_dn2=np.float32(0.3) * flats[5].within_dn2)
    found = find_saturation(DARKS, flats, 4095.0)
    assert (found.limit, found.level_dn) == ("not reached", None)
    assert [one.conditions.level for one in found.kept] == [0, 1, 2]
    assert "record two more levels" in found.left_out[0][1]


def flat_of(charges_e: list[float], exposure_s: float, seed: int) -> Series:
    rng = np.random.default_rng(seed)
    frames = [
        np.rint(OFFSET_DN + GAIN * (rng.poisson(it, (48, 48)) + rng.normal(0, READ_E, (48, 48)))) for it in charges_e
    ]
    named = [(f"{exposure_s:g} s {k}", frame.astype(np.uint16)) for k, frame in enumerate(frames)]
    return measure_series(named, Conditions("flat", exposure_s))


def test_frames_of_two_lights_in_one_series_are_named() -> None:
    """Twelve exposures of one lamp; of 6 ms one frame too many is stated as 12 ms."""
    flats = [flat_of([500.0 * k] * 2, 1e-3 * k, k) for k in (1, 2, 3, 4, 5, 7, 8, 9, 10, 11)]
    mixed = flat_of([6000.0, 6000.0, 3000.0, 3000.0], 12e-3, 20)
    with pytest.raises(BadFrame, match=r"^0.012 s [01]: mean 30\d\d.* DN, where 0.012 s [23] .* 15\d\d.*limit 5%"):
        calibrate([*DARKS, *flats, mixed], 4095.0)
    with pytest.raises(BadFrame, match="limit 50%"):
        calibrate([*DARKS, mixed], 4095.0)


@pytest.mark.parametrize("flicker", [0.0, 0.03])
def test_a_lamp_that_flickers_in_all_series_is_no_fault_of_one(flicker: float) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        flats = [
            flat_of((500.0 * k * (1 + flicker * rng.standard_normal(2))).tolist(), 1e-3 * k, k) for k in range(1, 8)
        ]
        check_flat_levels(DARKS, flats)
