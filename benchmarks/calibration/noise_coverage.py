"""Coverage of the intervals of the noise: `python -m benchmarks.calibration.noise_coverage [case ...] [--repeats N]`.

Sensors that bend, saturate, drift, flicker and scatter are simulated here, apart from `calib`. Every repeat draws
frames afresh and goes through the whole calibration. An interval holds if the truth is inside; quantities without a
value count on their own. The intervals of a quantity should hold 93 to 97 % of the time, or there should be none.

`--alarms` records sessions of ideal sensors instead, and counts the warnings and refusals, which all are false there.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import CalibrationError
from faintfield.calib.noise import Conditions, NoiseCalibration, Series, calibrate, measure_series
from faintfield.pipelines.calibration.noise_emva import measure_emva

type Array = NDArray[np.float64]

NAMES = ("gain_dn_per_e", "read_noise_e", "dark_current_e_per_s", "linearity_error")


@dataclass(frozen=True)
class Camera:
    """A sensor and the way it is lit; lengths of lists of frames are in `record`.

    `vignetting` is the share of the light that the corners of the frame lack.
    `bend` and `third` are the coefficients of s = K Q (1 + bend x + third x²), x = Q over `full_e`.
    """

    shape: tuple[int, int] = (48, 48)
    gain_dn_per_e: float = 0.1
    read_noise_e: float = 30.0
    dark_current_e_per_s: float = 20.0
    offset_dn: float = 60.0
    dsnu_e: float = 10.0
    prnu: float = 0.01
    vignetting: float = 0.0
    full_e: float = 40_000.0
    highest_dn: float = 4095.0
    well_e: float = np.inf
    well_spread: float = 0.03
    bend: float = 0.0
    third: float = 0.0
    light_error: float = 0.0
    flicker: float = 0.0
    drift_dn: float = 0.0
    jitter_dn: float = 0.0
    noise_error: float = 0.0
    telegraph: float = 0.0
    read_spread: float = 0.0

    def mean_dn(self, charge_e: Any) -> Any:
        """Return the signal of a charge."""
        x = charge_e / self.full_e
        return self.gain_dn_per_e * charge_e * (1 + self.bend * x + self.third * x**2)


def expose(
    camera: Camera, pixels: dict[str, Array], charge_e: float, dark_e: float, rng: np.random.Generator, **state: float
) -> NDArray[np.uint16]:
    """Take one frame (row, column) of mean charges by light and dark current; `more` in its state scales its noise."""
    mean_e = charge_e * pixels["response"] + dark_e
    noise_e = rng.poisson(mean_e) - mean_e + rng.normal(0, 1, camera.shape) * pixels["read_e"]
    flips = pixels["telegraph"] * (rng.random(camera.shape) < 0.3) * 8 * camera.read_noise_e
    electrons = np.minimum(mean_e + state["more"] * noise_e, pixels["well_e"]) + flips
    dn = pixels["offset_dn"] + camera.mean_dn(electrons) + state["shift_dn"] + camera.jitter_dn * rng.standard_normal()
    return np.asarray(np.clip(np.rint(dn), 0, camera.highest_dn), np.uint16)


def make_pixels(camera: Camera, rng: np.random.Generator) -> dict[str, Array]:
    """Return what differs from pixel to pixel."""
    normal = partial(rng.standard_normal, camera.shape)
    spread = np.exp(camera.read_spread * normal())
    rows, columns = (np.linspace(-1, 1, size) for size in camera.shape)
    light = 1 - camera.vignetting * np.add.outer(rows**2, columns**2) / 2
    return {
        "response": light / light.mean() * (1 + camera.prnu * normal()),
        "read_e": camera.read_noise_e * spread / np.sqrt(np.mean(spread**2)),
        "offset_dn": camera.offset_dn + camera.gain_dn_per_e * camera.dsnu_e * normal(),
        "telegraph": (rng.random(camera.shape) < camera.telegraph).astype(float),
        "well_e": camera.well_e * (1 + camera.well_spread * normal()),
    }


@dataclass(frozen=True)
class Session:
    """Frames to record: exposures and numbers of darks, and the charges of the flats, whose photons may be stated."""

    dark_s: tuple[float, ...] = (0.01, 1.0, 3.0, 10.0, 20.0, 30.0)
    dark_frames: int = 8
    charges_e: tuple[float, ...] = tuple(np.linspace(0.03, 0.95, 16) * 40_000)
    flat_frames: int = 4
    photons: bool = True


def record(camera: Camera, session: Session, rng: np.random.Generator) -> list[Series]:
    """Take and reduce all series."""
    pixels, series = make_pixels(camera, rng), list[Series]()

    def take(conditions: Conditions, frames: int, charge_e: float, dark_e: float) -> Series:
        shift = camera.drift_dn * rng.standard_normal()
        more = np.sqrt(max(1 + camera.noise_error * rng.standard_normal(), 0.1))
        lamp = 1 + camera.light_error * rng.standard_normal()
        taken = []
        for k in range(frames):
            charge = charge_e * lamp * (1 + camera.flicker * rng.standard_normal())
            frame = expose(camera, pixels, charge, dark_e, rng, shift_dn=shift, more=more)
            taken.append((f"{conditions} {k}", frame))
        return measure_series(taken, conditions, camera.highest_dn)

    current = camera.dark_current_e_per_s
    series += [take(Conditions("dark", t), session.dark_frames, 0.0, current * t) for t in session.dark_s]
    for level, charge in enumerate(session.charges_e):
        photons = charge / 0.5 if session.photons else None
        series.append(take(Conditions("flat", 0.01, level, photons), session.flat_frames, charge, 0.2))
    return series


def true_linearity(camera: Camera, result: NoiseCalibration) -> float:
    """Return EMVA 1288's linearity error of the true response at the levels that were used."""
    used = result.saturation.kept
    charge = np.array([0.5 * (flat.conditions.photons or 0.0) for flat in used])
    signal = camera.mean_dn(charge)
    full = signal.max() if result.saturation.level_dn is None else result.saturation.level_dn - camera.offset_dn
    inside = (signal >= 0.05 * full) & (signal <= 0.95 * full)
    line = np.polyfit(charge[inside], signal[inside], 1, w=1 / signal[inside])
    return float(np.mean(np.abs(signal[inside] / np.polyval(line, charge[inside]) - 1)))


def study(label: str, camera: Camera, session: Session, repeats: int, first_seed: int) -> None:
    """Print bias, scatter, coverage and the number of values of each quantity."""
    errors: dict[str, list[float]] = {name: [] for name in NAMES}
    held: dict[str, list[bool]] = {name: [] for name in NAMES}
    widths: dict[str, list[float]] = {name: [] for name in NAMES}
    refused: dict[str, int] = {}
    truths = [camera.gain_dn_per_e, camera.read_noise_e, camera.dark_current_e_per_s]
    for seed in range(first_seed, first_seed + repeats):
        try:
            result = calibrate(record(camera, session, np.random.default_rng(seed)), camera.highest_dn)
        except CalibrationError as failure:
            refused[type(failure).__name__] = refused.get(type(failure).__name__, 0) + 1
            continue
        bend = true_linearity(camera, result) if session.photons else np.nan
        for name, truth in zip(NAMES, (*truths, bend), strict=True):
            found = result.estimates[name]
            if found.value is None or found.ci95 is None:
                continue
            errors[name].append(found.value - truth)
            held[name].append(found.ci95[0] <= truth <= found.ci95[1])
            widths[name].append((found.ci95[1] - found.ci95[0]) / 2)
    print(f"{label}; {repeats} repeats{'; refused: ' + str(refused) if refused else ''}", flush=True)
    for name, truth in zip(NAMES, (*truths, 0.01), strict=True):
        if not errors[name]:
            print(f"  {name:22s} no value")
            continue
        error = np.array(errors[name]) / truth
        print(
            f"  {name:22s} {len(error):4d} values  bias {100 * error.mean():+.3f} %  rms {100 * error.std():.3f} %  "
            f"half width {100 * np.mean(widths[name]) / truth:.3f} %  hold {100 * np.mean(held[name]):.1f} %",
            flush=True,
        )


PLAIN, USUAL = Camera(), Session()
TO_SATURATION = replace(USUAL, charges_e=tuple(np.linspace(0.03, 1.2, 24) * 40_000))
CASES: dict[str, tuple[Camera, Session]] = {
    "straight": (PLAIN, USUAL),
    "quadratic 1 %": (replace(PLAIN, bend=-0.01), USUAL),
    "quadratic 2 %": (replace(PLAIN, bend=-0.02), USUAL),
    "quadratic 5 %": (replace(PLAIN, bend=-0.05), USUAL),
    "S-shaped": (replace(PLAIN, bend=0.12, third=-0.10), USUAL),
    "levels off by 0.5 %": (replace(PLAIN, bend=-0.02, light_error=0.005), USUAL),
    "flicker 1 %": (replace(PLAIN, bend=-0.02, flicker=0.01), USUAL),
    "noise off by 2 %": (replace(PLAIN, bend=-0.02, noise_error=0.02), USUAL),
    "drift 1 DN": (replace(PLAIN, bend=-0.02, drift_dn=1.0), USUAL),
    "drift 0.2 DN": (replace(PLAIN, bend=-0.02, drift_dn=0.2), USUAL),
    "jitter 0.5 DN": (replace(PLAIN, bend=-0.02, jitter_dn=0.5), USUAL),
    "telegraph pixels 1 %": (replace(PLAIN, bend=-0.02, telegraph=0.01), USUAL),
    "read noise log-normal 0.3": (replace(PLAIN, bend=-0.02, read_spread=0.3), USUAL),
    "to the converter's end": (replace(PLAIN, bend=-0.02), TO_SATURATION),
    "to the full well": (replace(PLAIN, bend=-0.02, well_e=32_000.0), TO_SATURATION),
    "light unknown": (replace(PLAIN, bend=-0.01), replace(USUAL, photons=False)),
    "pairs": (replace(PLAIN, bend=-0.02), replace(TO_SATURATION, flat_frames=2, dark_frames=2)),
}

IDEAL = replace(PLAIN, prnu=0.0)
SESSION = Session((0.01, 3.0, 10.0, 30.0), 6, (4e3, 8e3, 12e3, 18e3, 24e3, 32e3), 4)
IDEAL_CASES: dict[str, tuple[Camera, Session]] = {
    "48 x 48, even light": (IDEAL, SESSION),
    "40 x 64, PRNU 1 %, vignetting 45 %": (replace(IDEAL, shape=(40, 64), prnu=0.01, vignetting=0.45), SESSION),
    "64 x 96, three levels, vignetting 45 %": (
        replace(IDEAL, shape=(64, 96), vignetting=0.45),
        replace(SESSION, charges_e=(1e3, 3e3, 6e3), flat_frames=3),
    ),
    "48 x 48, 2 frames of each, vignetting 30 %, bend 2 %": (
        replace(IDEAL, bend=-0.02, vignetting=0.3),
        replace(SESSION, flat_frames=2, dark_frames=2),
    ),
    "32 x 40, one dim level, 12 frames": (
        replace(IDEAL, shape=(32, 40)),
        replace(SESSION, charges_e=(2e3,), flat_frames=12, dark_frames=10),
    ),
}

# Rates of false alarms that are stated for a session, by words of a warning, and of what else the result says.
WARNINGS = {
    "the noise of the series scatters": 1e-3,
    "the dark level drifts": 1e-3,
    "the levels of the flats scatter": 1e-3,
    "the dark level against exposure time": 1e-4,
    "% off the model's": 1e-6,
    "are stated, their level is that of": 1e-4,
    "series of flats are left out": 1e-6,
    "values are cut off": 1e-6,
    "the gain differs": 6e-4,
    "the offset differs": 6e-4,
    "jump between two levels": 1e-3,
    "PRNU is not measured": 1e-6,
}
RESULTS = {
    "PRNU or a part of it hidden": 5e-3,
    "DSNU, DCNU or a part hidden": 7e-3,
    "jitter, line noise or flicker hidden": 4e-3,
    "PRNU's interval off": 0.05,
    "PRNU's pixel part's interval off": 0.05,
    "no gain": 1e-4,
    "a map of the gain": 2e-3,
    "hot pixels": 1e-3,
    "noisy pixels": 1e-2,
    "dead pixels": 1e-6,
}


def find_alarms(camera: Camera, series: list[Series]) -> Iterator[str]:
    """Yield the name of each false alarm of a session of an ideal sensor."""
    try:
        result = calibrate(series, camera.highest_dn)
    except CalibrationError as failure:
        yield f"refused: {type(failure).__name__}"
        return
    for warning in result.warnings:
        if "light of the flats is not known" not in warning:  # which says what is recorded, and is no alarm
            yield next((words for words in WARNINGS if words in warning), warning)
    everything = result.estimates | measure_emva("", series, result, {}).estimates
    hidden = [name for name, found in everything.items() if "less scatter" in (found.why or "")]
    for group, starts in zip(RESULTS, (("prnu",), ("dsnu", "dcnu"), ("frame", "row", "column", "lamp")), strict=False):
        if any(name.startswith(starts) for name in hidden):
            yield group
    for name, alarm in (("prnu", "PRNU's interval off"), ("prnu_pixel", "PRNU's pixel part's interval off")):
        low, high = everything[name].ci95 or (0.0, np.inf)
        if not low <= camera.prnu <= high:
            yield alarm
    if everything["gain_dn_per_e"].value is None:
        yield "no gain"
    if result.pixels.gain is not None:
        yield "a map of the gain"
    for kind in ("hot", "noisy", "dead"):
        if getattr(result.pixels, kind).any():
            yield f"{kind} pixels"


def count_alarms(label: str, camera: Camera, session: Session, repeats: int, first_seed: int) -> None:
    """Print the rate of each false alarm of ideal sessions beside the one that is stated."""
    counts: Counter[str] = Counter()
    for seed in range(first_seed, first_seed + repeats):
        counts.update(set(find_alarms(camera, record(camera, session, np.random.default_rng(seed)))))
    stated = WARNINGS | RESULTS
    print(f"{label}; {repeats} sessions", flush=True)
    for name in [*stated, *(name for name in counts if name not in stated)]:
        if name in RESULTS or counts[name]:
            limit = f"stated {stated[name]:.2g}" if name in stated else "none stated"
            print(f"  {name:40s} {counts[name]:4d}  {counts[name] / repeats:.2%}  {limit}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", choices=[*CASES, *IDEAL_CASES, []], default=[])
    parser.add_argument("--alarms", action="store_true", help="count false alarms of ideal sensors")
    parser.add_argument("--repeats", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1000)
    arguments = parser.parse_args()
    cases, run = (IDEAL_CASES, count_alarms) if arguments.alarms else (CASES, study)
    for chosen in arguments.cases or cases:
        run(chosen, *cases[chosen], arguments.repeats, arguments.seed)
