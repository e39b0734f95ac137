"""Accuracy and speed of noise calibration: `python -m benchmarks.calibration.noise_accuracy [study ...] [--repeats N]`.

Errors are divided by the Cramér-Rao bound of the same frames; 1.00 cannot be beaten. Frames are simulated afresh in
every repeat and go through the whole calibration. The tests run the same studies with fewer repeats.
"""

import argparse
import resource
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from faintfield.calib.noise import Conditions, Series, calibrate, measure_series
from faintfield.calib.noise.likelihood.marginal import PARAMETERS, Counts, MarginalLikelihood
from tests.calib.noise.cramer_rao import Sensor, cramer_rao
from tests.calib.noise.darkroom import darks, expose, specimen

EXPOSURES_S = (0.1, 1.0, 10.0, 60.0)
ROUGH = {"jitter_dn": 1.0, "banding_dn": 1.0, "hot_fraction": 0.005, "dcnu": 0.1}
NAMES = ("gain_dn_per_e", "read_noise_e", "dark_current_e_per_s")


def take(seed: int, exposures_s: tuple[float, ...] = EXPOSURES_S, frames: int = 10, **changes: Any) -> list[Series]:
    """Simulate darks and reduce them."""
    taken = darks(*_split(specimen(seed, **changes), exposures_s, frames))
    return [measure_series(series, Conditions("dark", t)) for t, series in taken.items()]


def _split(made: tuple[Any, Any], exposures_s: tuple[float, ...], frames: int) -> tuple[Any, Any, int, Any]:
    """Return the arguments of `darks` for a chip and its generator."""
    return made[0], exposures_s, frames, made[1]


def study(label: str, repeats: int, bound: dict[str, float], read_noise_e: float = 12**0.5, **changes: Any) -> None:
    """Print bias, error over bound, and coverage of the 95 % intervals."""
    truth = dict(zip(NAMES, (2.0, read_noise_e, 0.2), strict=True))
    values: dict[str, list[float]] = {name: [] for name in NAMES}
    covered = dict.fromkeys(NAMES, 0)
    for seed in range(repeats):
        result = calibrate(take(50_000 + seed, read_noise_e=read_noise_e, **changes))
        for name in NAMES:
            estimate = result.estimates[name]
            if estimate.value is None or estimate.ci95 is None:
                raise SystemExit(f"{label}: {name} has no value: {estimate.why}")
            values[name].append(estimate.value)
            covered[name] += estimate.ci95[0] <= truth[name] <= estimate.ci95[1]
    print(f"{label}; {repeats} repeats; {result.likelihood}")
    for name in NAMES:
        error = np.array(values[name]) - truth[name]
        rms = float(np.sqrt(np.mean(error**2)))
        print(
            f"  {name:22s} bias {100 * error.mean() / truth[name]:+.2f} %   rms error {100 * rms / truth[name]:.2f} %"
            f" = {rms / bound[name]:.3f} x bound   95 % intervals cover {100 * covered[name] / repeats:.1f} %"
        )


def plain(repeats: int) -> None:
    """Study the paper's camera."""
    bound = cramer_rao(Sensor(2.0, 12**0.5, 0.2, dsnu_e=1.5), EXPOSURES_S, 10, 64 * 64)
    study("paper's camera, 64 x 64", repeats, bound)


def rough(repeats: int) -> None:
    """Study the same camera with jitter, banding, hot pixels and DCNU."""
    sensor = Sensor(2.0, 12**0.5, 0.2, dsnu_e=1.5, dcnu_e_per_s=0.02, jitter_dn=1.0)
    bound = cramer_rao(sensor, EXPOSURES_S, 10, 64 * 64)
    study("jitter 1 DN, banding 1 DN, 0.5 % hot, DCNU 10 %", repeats, bound, **ROUGH)


def clipped(repeats: int) -> None:
    """Study values clipped at black."""
    for offset_dn in (0.0, 5.0):
        bound = _bound_of_values(12**0.5, floor_dn=0, offset_dn=offset_dn)
        study(f"clipped at black, offset {offset_dn:g} DN, 64 x 64", repeats, bound, offset_dn=offset_dn)


def subtle(repeats: int) -> None:
    """Study read noise below an electron."""
    study("read noise 0.3 e-, 64 x 64", repeats, _bound_of_values(0.3), read_noise_e=0.3)


def _bound_of_values(read_noise_e: float, floor_dn: int | None = None, offset_dn: float = 100.0) -> dict[str, float]:
    """Return the bound of the likelihood of single values, from the scores at the truth of 16 384 pixels."""
    series = take(1, read_noise_e=read_noise_e, offset_dn=offset_dn, shape=(128, 128))
    counts = Counts(EXPOSURES_S, tuple(darks.sample_dn for darks in series), floor_dn)
    truth = np.array([np.log(2.0), np.log(read_noise_e), np.log(0.2), 0.0, offset_dn, np.log(3.0)])
    start = dict(zip(PARAMETERS, truth, strict=True))
    _, _, scores = MarginalLikelihood(counts, start, exact=True, spread=False).evaluate(truth)
    free = [i for i, name in enumerate(PARAMETERS) if name != "dcnu"]
    error = np.sqrt(np.diag(np.linalg.inv(scores[np.ix_(free, free)] / 4)))
    return {name: float(e * value) for name, e, value in zip(NAMES, error, (2.0, read_noise_e, 0.2), strict=False)}


def hot(repeats: int) -> None:
    """Study the detection of hot pixels."""
    true = found = both = 0
    for seed in range(max(repeats // 20, 5)):
        chip, rng = specimen(seed, shape=(256, 256), hot_fraction=0.005, dcnu=0.1)
        taken = darks(chip, EXPOSURES_S, 10, rng)
        result = calibrate([measure_series(series, Conditions("dark", t)) for t, series in taken.items()])
        true += int(chip.hot.sum())
        found += int(result.pixels.hot.sum())
        both += int((chip.hot & result.pixels.hot).sum())
    print(f"hot pixels: {true} true, recall {both / true:.4f}, precision {both / found:.4f}")


def short(repeats: int) -> None:
    """Study darks of at most a second, which do not determine the gain."""
    numbers = 0
    for seed in range(repeats):
        result = calibrate(take(seed, (0.1, 0.3, 1.0), shape=(128, 128)))
        numbers += sum(result.estimates[name].value is not None for name in NAMES)
    print(f"darks up to 1 s without flats: {numbers} numbers given in {repeats} repeats (must be 0)")


def speed(_: int) -> None:
    """Measure time and memory."""
    taken = darks(*_split(specimen(1, shape=(256, 256)), EXPOSURES_S, 10))
    for _ in range(2):
        begun = time.perf_counter()
        series = [measure_series(frames, Conditions("dark", t)) for t, frames in taken.items()]
        reduced = time.perf_counter()
        calibrate(series)
    print(f"256 x 256 x 40: statistics {reduced - begun:.3f} s, calibration {time.perf_counter() - reduced:.3f} s")
    chip, rng = specimen(2, shape=(1024, 1024))
    spent = 0.0

    def frames(exposure_s: float) -> Iterator[tuple[str, Any]]:
        nonlocal spent
        for k in range(25):
            begun = time.perf_counter()
            frame = expose(chip, exposure_s, rng)
            spent += time.perf_counter() - begun
            yield f"{exposure_s:g} {k}", frame

    begun = time.perf_counter()
    calibrate([measure_series(frames(t), Conditions("dark", t)) for t in EXPOSURES_S])
    took = time.perf_counter() - begun - spent
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"1 Mpx x 100: {took:.1f} s, peak {peak_gb:.2f} GB (the simulation's memory included)")


STUDIES: dict[str, Callable[[int], None]] = {
    name.__name__: name for name in (plain, rough, clipped, subtle, hot, short, speed)
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("studies", nargs="*", choices=[*STUDIES, []], default=list(STUDIES))
    parser.add_argument("--repeats", type=int, default=200)
    arguments = parser.parse_args()
    for chosen in arguments.studies:
        STUDIES[chosen](arguments.repeats)
