"""Two measurements of a camera's noise compared: which quantities, pixels and maps have changed since."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.estimate import NORMAL_QUANTILE, Estimate
from faintfield.pipelines.errors import BadValue, WrongSize
from faintfield.pipelines.formats.frames import at_phase, mosaic_period
from faintfield.pipelines.formats.results.noise import (
    NOISE_FILE,
    NOISE_MAPS,
    NoiseRecord,
    PhaseRecord,
    Quantities,
    read_maps,
    read_noise,
)

# Probability that any quantity at all is called changed though nothing has.
CHANCE = 0.05

# Smallest growth of the difference of two maps over what their errors make that counts: the errors are known no better.
_MIN_GROWTH = 0.1

# Of the fit and of the report by EMVA 1288, those that do not follow from others.
_OF_FIT = ("saturation_e", "linearity_error")
_OF_EMVA = ("prnu_row", "prnu_column")

_KINDS = ("hot", "noisy", "dead")

type Array = NDArray[np.float64]
type Verdict = Literal["changed", "unchanged", "not comparable"]


class Change(Struct, frozen=True, omit_defaults=True):
    """One quantity of both measurements, with their difference in standard errors, or the reason why there is none."""

    name: str
    first: float | None
    second: float | None
    difference: float | None
    sigma: float | None
    verdict: Verdict
    plane: str = ""
    why: str | None = None


class PixelChange(Struct, frozen=True):
    """Numbers of pixels that only the first, only the second, or both measurements call unusable, of one kind."""

    kind: str
    only_first: int
    only_second: int
    both: int


class MapChange(Struct, frozen=True, omit_defaults=True):
    """The difference of both offset maps, its mean taken out: its rms, and the rms that the errors of both make."""

    name: str
    pixels: int
    rms_dn: float | None
    expected_dn: float | None
    verdict: Verdict
    plane: str = ""
    why: str | None = None


class NoiseComparison(Struct, frozen=True):
    """The result of `faintfield noise --compare`.

    `comparisons` is the number m of verdicts that can be given; each is "changed" below a probability of `CHANCE`/m.
    """

    first: str
    second: str
    comparisons: int
    limit_sigma: float
    quantities: list[Change]
    pixels: list[PixelChange]
    maps: list[MapChange]
    changed: list[str]
    notes: list[str]


def compare_noise(first: Path, second: Path) -> NoiseComparison:
    """Return what has changed from one noise.json, or its folder, to another.

    Raises
    ------
    MissingFile, BadValue
        A file cannot be read, or is no result of `faintfield noise`.
    WrongSize, BadValue
        The sensors differ in size or in colour filters.
    """
    paths = [path / NOISE_FILE if path.is_dir() else path for path in (first, second)]
    records = read_noise(paths[0]), read_noise(paths[1])
    _check_alike(paths, *records)
    rows: list[tuple[Change | MapChange, float | None]] = [*_quantities(*records), *_maps(paths, *records)]
    count = sum(probability is not None for _, probability in rows)
    level = CHANCE / max(count, 1)
    judged = [
        row if probability is None or probability >= level else msgspec.structs.replace(row, verdict="changed")
        for row, probability in rows
    ]
    return NoiseComparison(
        first=str(paths[0]),
        second=str(paths[1]),
        comparisons=count,
        limit_sigma=float(stats.norm.isf(level / 2)),
        quantities=[row for row in judged if isinstance(row, Change)],
        pixels=[_pixel_change(kind, *records) for kind in _KINDS],
        maps=[row for row in judged if isinstance(row, MapChange)],
        changed=[label(row) for row in judged if row.verdict == "changed"],
        notes=list(_notes(*records)),
    )


def label(row: Change | MapChange) -> str:
    """Return the name of a quantity or map with that of its plane."""
    name = f"{row.name} map" if isinstance(row, MapChange) else row.name
    return f"{row.plane}: {name}" if row.plane else name


def _check_alike(paths: Sequence[Path], first: NoiseRecord, second: NoiseRecord) -> None:
    if first.size_px != second.size_px:
        sizes = [
            " x ".join(map(str, record.size_px)) + " px" if record.size_px else "of no stated size"
            for record in (first, second)
        ]
        raise WrongSize(
            f"{paths[1]}: is {sizes[1]}, {paths[0]} is {sizes[0]}: they are not of one camera in one mode; name "
            "two measurements of the same"
        )
    if (first.mosaic or None) != (second.mosaic or None):
        filters = ["/".join(record.mosaic) if record.mosaic else "none" for record in (first, second)]
        raise BadValue(
            f"{paths[1]}: has the colour filters {filters[1]}, {paths[0]} has {filters[0]}: they are not of one "
            "camera; name two measurements of the same"
        )


def _phases(first: NoiseRecord, second: NoiseRecord) -> Iterator[tuple[str, Quantities, Quantities]]:
    if not first.planes or not second.planes:
        yield "", first, second
        return
    others = {plane.phase: plane for plane in second.planes}
    for plane in first.planes:
        if plane.phase in others:
            yield _name(plane), plane, others[plane.phase]


def _name(plane: PhaseRecord) -> str:
    return f"{plane.colour}_r{plane.phase[0]}c{plane.phase[1]}"


def _quantities(first: NoiseRecord, second: NoiseRecord) -> Iterator[tuple[Change, float | None]]:
    """Yield the comparison of each quantity, and the probability of its difference; None without."""
    for plane, of_first, of_second in _phases(first, second):
        known = _measured(of_first), _measured(of_second)
        for name in known[0]:
            change = _change(name, plane, known[0][name], known[1][name])
            yield change, None if change.sigma is None else chance(change.sigma)


def _measured(quantities: Quantities) -> dict[str, Estimate]:
    """Return the quantities to compare, by name; a reason stands for those that an older file lacks."""
    lacking = Estimate(None, why="not in this file: it is of an older version")
    fit, emva = getattr(quantities, "fit", None), getattr(quantities, "emva1288", None)
    found = {name: getattr(quantities, name) for name in Quantities.__struct_fields__}
    found |= {name: getattr(fit, name) if fit else lacking for name in _OF_FIT}
    found |= {name: getattr(emva, name) if emva else lacking for name in _OF_EMVA}
    return {name: value if isinstance(value, Estimate) else Estimate(value) for name, value in found.items()}


def _change(name: str, plane: str, first: Estimate, second: Estimate) -> Change:
    if first.value is None or second.value is None:
        whys = {which: it.why or "no reason stated" for which, it in (("A", first), ("B", second)) if it.value is None}
        if len(whys) == 2 and first.why == second.why:
            whys = {"A and B": whys["A"]}
        why = "; ".join(f"{which}: {reason}" for which, reason in whys.items())
        return Change(name, first.value, second.value, None, None, "not comparable", plane, why)
    difference, sigma, reason = second.value - first.value, None, None
    if first.ci95 is None or second.ci95 is None:
        reason = "no interval is stated"
    else:
        sigma = difference_in_sigma(first.value, first.ci95, second.value, second.ci95)
        if not np.isfinite(sigma):
            sigma, reason = (None, "both errors are 0") if difference else (0.0, None)
    verdict: Verdict = "not comparable" if sigma is None else "unchanged"
    return Change(name, first.value, second.value, difference, sigma, verdict, plane, reason)


def difference_in_sigma(
    first: float, first_ci95: tuple[float, float], second: float, second_ci95: tuple[float, float]
) -> float:
    """Return second − first over its standard error; NaN where neither has one.

    Each error is that of the side of the interval that faces the other value: intervals near a limit are lopsided.
    """
    (low, high) = (first_ci95, second_ci95) if second >= first else (second_ci95, first_ci95)
    below, above = min(first, second), max(first, second)
    error = float(np.hypot(low[1] - below, above - high[0])) / NORMAL_QUANTILE
    return (second - first) / error if error > 0 else float("nan")


def chance(sigma: float) -> float:
    """Return the probability that two measurements of one value differ by so many standard errors or more."""
    return float(2 * stats.norm.sf(abs(sigma)))


def _pixel_change(kind: str, first: NoiseRecord, second: NoiseRecord) -> PixelChange:
    before, after = (set(map(tuple, getattr(record, f"{kind}_pixels"))) for record in (first, second))
    return PixelChange(kind, len(before - after), len(after - before), len(before & after))


def _maps(paths: Sequence[Path], first: NoiseRecord, second: NoiseRecord) -> Iterator[tuple[MapChange, float | None]]:
    """Yield the comparison of the offset maps of each phase, likewise."""
    name, names = "offset_dn", ("offset_dn", "offset_variance_dn2", "mask")
    if first.size_px is None:
        return
    shape = first.size_px[::-1]
    maps = [
        read_maps(path.with_name(NOISE_MAPS), record, shape, names)
        for path, record in zip(paths, (first, second), strict=True)
    ]
    lacking = [which for which, names_of_maps in zip("AB", maps, strict=True) if set(names_of_maps) != set(names)]
    if lacking:
        why = f"{' and '.join(lacking)}: no offset map with its errors lies beside {NOISE_FILE}"
        yield MapChange(name, 0, None, None, "not comparable", why=why), None
        return
    period = mosaic_period(first.mosaic or None)
    usable = ~(maps[0]["mask"].astype(bool) | maps[1]["mask"].astype(bool))
    for plane, phase in [(_name(plane), plane.phase) for plane in first.planes or []] or [("", (0, 0))]:
        used = at_phase(usable, phase, period)
        if used.sum() < 2:
            yield MapChange(name, 0, None, None, "not comparable", plane, "no pixel is usable in both"), None
            continue
        values = (np.asarray(at_phase(of[key], phase, period)[used], np.float64) for of in maps for key in names[:2])
        rms, expected, probability = compare_maps(*values)
        yield MapChange(name, int(used.sum()), rms, expected, "unchanged", plane), probability


def compare_maps(first: Array, first_variance: Array, second: Array, second_variance: Array) -> tuple[float, ...]:
    """Compare two maps of posterior means, arrays (pixel,), each with the variance of its errors.

    A map with a spread s² over the pixels, whose errors have the variance V, is w times a measurement, w = 1 − V/s²,
    with noise of variance w V. The difference of two maps of the same pixels thus has the variance
    w₁ V₁ + w₂ V₂ + (w₁ − w₂)² s².

    Returns
    -------
    rms, expected, chance : float
        Rms of the difference, its mean taken out; what the errors of both maps make of it; and the probability of so
        large an rms without a change: 1 if it exceeds its expectation by no more than the errors are known.
    """
    difference = second - first
    errors = np.array([first_variance.mean(), second_variance.mean()])
    spreads = np.array([first.var(), second.var()]) + errors
    weights = 1 - errors / np.maximum(spreads, 1e-300)
    expected2 = float(weights @ errors + (weights[0] - weights[1]) ** 2 * spreads.mean())
    rms2, freedom = float(difference.var(ddof=1)), difference.size - 1
    ratio = freedom * rms2 / expected2 if expected2 > 0 else (np.inf if rms2 > 0 else 0.0)
    rms, expected = float(np.sqrt(rms2)), float(np.sqrt(expected2))
    return rms, expected, float(stats.chi2.sf(ratio, freedom)) if rms > (1 + _MIN_GROWTH) * expected else 1.0


def _notes(first: NoiseRecord, second: NoiseRecord) -> Iterator[str]:
    """Yield what else differs between the measurements, which may be the reason for a change."""
    warmth = [record.temperature_c.mean if record.temperature_c else None for record in (first, second)]
    if None in warmth:
        yield "a temperature is not stated: dark current may have changed by 10 % per kelvin"
    elif warmth[0] != warmth[1]:
        yield f"A was measured at {warmth[0]:.1f} °C, B at {warmth[1]:.1f} °C; dark current changes by 10 % per kelvin"
    if first.likelihood != second.likelihood:
        yield f"the likelihoods differ: {first.likelihood or 'not stated'}, then {second.likelihood or 'not stated'}"
