"""Noise sets on disk, for the tests of the commands that read them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import tifffile
import tomli_w
from numpy.typing import NDArray

from faintfield.pipelines.commands.calibration import noise
from faintfield.pipelines.formats.results.noise import NoiseRecord
from tests.calib.noise.darkroom import Chip, expose


def write_frames(folder: Path, frames: Sequence[tuple[NDArray[Any], Mapping[str, Any]]], **settings: Any) -> Path:
    """Write frames as TIFF with `noise.toml`; each comes with the keys of its entry, named in order if not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for index, (pixels, keys) in enumerate(frames):
        name = f"{keys['kind']}_{index:02d}.tiff"
        tifffile.imwrite(folder / name, pixels)
        entries.append({"file": name} | dict(keys))
    (folder / "noise.toml").write_text(tomli_w.dumps({"format": 1, **settings, "frame": entries}))
    return folder


def take_set(
    chip: Chip,
    rng: np.random.Generator,
    exposures_s: Sequence[float] = (0.1, 1.0, 10.0, 60.0),
    frames: int = 4,
    photons: Sequence[float] = (),
) -> list[tuple[NDArray[np.uint16], dict[str, Any]]]:
    """Take darks, and `frames` flats of 0.1 s at each light level."""
    taken: list[tuple[NDArray[np.uint16], dict[str, Any]]] = [
        (expose(chip, t, rng), {"kind": "dark", "exposure_s": t, "temperature_c": -10.0})
        for t in exposures_s
        for _ in range(frames)
    ]
    for level, light in enumerate(photons):
        keys = {"kind": "flat", "exposure_s": 0.1, "temperature_c": -10.0, "level": level, "photons": light}
        taken += [(expose(chip, 0.1, rng, light), keys) for _ in range(frames)]
    return taken


def measure_sensor(folder: Path, out: Path | None = None) -> NoiseRecord:
    """Call `faintfield noise` without drawing its page, which takes nearly all of the time."""
    with mock.patch("faintfield.pipelines.workflows.noise.noise_page", return_value="page"):
        return noise(folder, out=out)


def check_noise_of_eq_6(electrons: NDArray[Any], expected: NDArray[np.float64], read_e2: float) -> NDArray[np.float64]:
    """Assert that electrons scatter as Poisson counts and read noise do; return the normalised residuals."""
    variance = expected + read_e2
    normalised = np.asarray((electrons - expected) / np.sqrt(variance))
    assert abs(normalised.mean()) < 4 / np.sqrt(normalised.size)
    # A nearly normal number's square has the variance 2, and a Poisson count of mean μ adds μ / variance² to it
    deviation = np.sqrt(np.mean(2 + expected / variance**2) / normalised.size)
    assert abs(np.mean(normalised**2) - 1) < 4 * deviation
    return normalised


def deviation_of_snr(snr: float, mean_e: NDArray[np.float64], read_e2: float, region: NDArray[np.bool_]) -> float:
    """Return the deviation of a measured SNR, <g²> / <n²> - 1, whose g are the pixels of a region.

    Means of squares of m ± s: the variance is 2 s⁴ + 4 m² s² and, for a Poisson count, m + 4 m² more, over the number
    of pixels.
    """
    variance = mean_e + read_e2
    of_object = np.mean(2 * variance**2 + 4 * mean_e**2 * variance + mean_e + 4 * mean_e**2) / region.sum()
    return float(np.sqrt(of_object + (1 + snr) ** 2 * 2 * read_e2**2 / region.size) / read_e2)
