"""`faintfield noise`: a sensor measured from dark and flat frames."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from faintfield.calib.errors import CalibrationError
from faintfield.calib.noise import NoiseCalibration, calibrate
from faintfield.pipelines.calibration.noise_frames import Plane, read_series
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.files import remove, sha256, write_json, write_whole
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.fitted_noise import NOISE_FILE, NOISE_MAPS
from faintfield.pipelines.formats.results.noise import STANDARD, maps_of, result_of, write_maps
from faintfield.pipelines.formats.sets.noise_set import FILE_NAME, load_noise_set, temperature_notes
from faintfield.pipelines.pages.noise_page import draw_page
from faintfield.rig.session.session import PLAN

# By so much the masked pixels' mean may differ from the others' in a sound camera.
_BLACK_TOLERANCE_DN = 2.0

_SHOWN = (
    ("gain_dn_per_e", "K, system gain", "DN/e⁻"),
    ("offset_dn", "mu_y.dark(0), offset", "DN"),
    ("read_noise_e", "sigma_d, read noise", "e⁻"),
    ("dark_current_e_per_s", "mu_I, dark current", "e⁻/s"),
    ("dsnu_e", "DSNU (pixel)", "e⁻"),
    ("prnu", "PRNU (pixel)", ""),
    ("quantum_efficiency", "eta, quantum efficiency", "e⁻/photon"),
)


def noise(folder: Path, /, *, out: Path | None = None) -> dict[str, Any]:
    """Measure offset, gain, read noise and dark current from dark frames, and flats if there are any.

    Writes noise.json (numbers with 95 % intervals, or why there are none), noise_maps.npz (per pixel) and a page of
    plots, noise_page.png.

    Parameters
    ----------
    folder
        A session with dark frames, or a folder with noise.toml and the frames that it names.
    out
        Where to write; FOLDER itself if not given.
    """
    if not folder.exists():
        raise MissingFile(f"{folder}: no such folder; name a folder with {FILE_NAME} and frames")
    folder, settings = load_noise_set(folder)
    out = out or folder
    readout = read_series(folder, settings)
    calibrations = [_calibrate_plane(plane, readout.saturation_dn) for plane in readout.planes]
    temperature_c, doubts = temperature_notes(settings)
    doubts += [warning for calibration in calibrations for warning in calibration.warnings]
    described_in = FILE_NAME if (folder / FILE_NAME).is_file() else PLAN
    inputs = {name: sha256(folder / name) for name in [described_in, *(frame.file for frame in settings.frame)]}
    # The numbers come last: where noise.json stands, everything that it names stands too.
    remove(out / NOISE_FILE)
    write_maps(out / NOISE_MAPS, maps_of(readout, calibrations))
    result = result_of(readout, calibrations) | {
        "temperature_c": temperature_c,
        "frames": msgspec.to_builtins(settings.frame),
        "warnings": list(dict.fromkeys(doubts)),
        "maps": NOISE_MAPS,
        "maps_sha256": sha256(out / NOISE_MAPS),
        "provenance": provenance("noise", {}, inputs),
    }
    for plane, calibration in zip(readout.planes, calibrations, strict=True):
        suffix = f"_{plane.name}" if plane.name else ""
        write_whole(out / f"noise_page{suffix}.png", draw_page(calibration, f"{folder.resolve().name} {plane.name}"))
    write_json(out / NOISE_FILE, result)
    _tell(out, result)
    return result


def _calibrate_plane(plane: Plane, saturation_dn: float) -> NoiseCalibration:
    """Calibrate one colour phase, whose name goes into what is said about it."""
    prefix = f"plane {plane.name}: " if plane.name else ""
    try:
        calibration = calibrate(plane.series, saturation_dn)
    except CalibrationError as failure:
        raise type(failure)(f"{prefix}{failure}") from failure
    doubts = [*calibration.warnings, *_black_level_doubts(plane, calibration)]
    return replace(calibration, warnings=tuple(prefix + doubt for doubt in doubts))


def _black_level_doubts(plane: Plane, calibration: NoiseCalibration) -> list[str]:
    """Return a warning where masked pixels and covered ones disagree on what is black."""
    offset = calibration.estimates["offset_dn"]
    if not plane.black_dn or offset.value is None:
        return []
    black_dn = sum(plane.black_dn) / len(plane.black_dn)
    if abs(offset.value - black_dn) <= _BLACK_TOLERANCE_DN + 3 * (offset.se or 0.0):
        return []
    return [
        f"the darks' offset is {offset.value:.1f} DN, the black level that the files bring {black_dn:.1f} DN (at most "
        f"{_BLACK_TOLERANCE_DN:g} DN apart is usual); the lens was not quite covered, or the amplifier glows"
    ]


def _tell(out: Path, result: dict[str, Any]) -> None:
    """Say the main numbers and every doubt."""
    inform(f"{STANDARD}; likelihood: {result['likelihood']}")
    said: dict[str, str] = {}
    for name, label, unit in _SHOWN:
        estimate = result[name]
        if estimate["value"] is None:
            reason = estimate["why"]
            inform(f"  {label}: not identifiable: {'as for ' + said[reason] if reason in said else reason}")
            said.setdefault(reason, label.partition(",")[0])
        else:
            low, high = estimate["ci95"]
            inform(f"  {label}: {estimate['value']:.5g} {unit} (95 %: {low:.5g} to {high:.5g})")
    counts = {kind: len(result[f"{kind}_pixels"]) for kind in ("hot", "noisy", "dead")}
    inform("  pixels: " + ", ".join(f"{count} {kind}" for kind, count in counts.items()))
    for warning in result["warnings"]:
        inform(f"  warning: {warning}")
    inform(f"{out / NOISE_FILE}")
