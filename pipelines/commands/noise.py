"""`faintfield noise`: a sensor measured from dark and flat frames."""

from pathlib import Path

from faintfield.pipelines.calibration.noise import calibrate_sensor, noise_maps, noise_record
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.results.noise import NOISE_FILE, STANDARD, NoiseRecord, write_noise
from faintfield.pipelines.formats.results.noise_fit import FitRecord, Measured
from faintfield.pipelines.formats.sets.noise_set import FILE_NAME, load_noise_set
from faintfield.pipelines.pages.noise_page import draw_page

_SHOWN = (
    ("gain_dn_per_e", "K, system gain", "DN/e⁻"),
    ("offset_dn", "mu_y.dark(0), offset", "DN"),
    ("read_noise_e", "sigma_d, read noise", "e⁻"),
    ("dark_current_e_per_s", "mu_I, dark current", "e⁻/s"),
    ("dsnu_e", "DSNU (pixel)", "e⁻"),
    ("prnu", "PRNU (pixel)", ""),
    ("quantum_efficiency", "eta, quantum efficiency", "e⁻/photon"),
)


def noise(folder: Path, /, *, out: Path | None = None) -> NoiseRecord:
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
    sensor = calibrate_sensor(folder, settings)
    pages = {
        f"noise_page{f'_{phase.name}' if phase.name else ''}.png": draw_page(
            calibration, f"{folder.resolve().name} {phase.name}"
        )
        for phase, calibration in zip(sensor.readout.phases, sensor.phases, strict=True)
    }
    record = write_noise(out, noise_record(sensor), noise_maps(sensor), pages)
    _inform_of(record)
    inform(f"{out / NOISE_FILE}")
    return record


def _inform_of(record: NoiseRecord) -> None:
    """Print the main numbers and every warning; a reason that holds for several numbers is given once."""
    inform(f"{STANDARD}; likelihood: {record.likelihood}")
    explained: dict[str, str] = {}
    for name, label, unit in _SHOWN:
        measured: Measured = getattr(record, name)
        if measured.value is None or measured.ci95 is None:
            reason = measured.why or ""
            inform(f"  {label}: not identifiable: {'as for ' + explained[reason] if reason in explained else reason}")
            explained.setdefault(reason, label.partition(",")[0])
        else:
            low, high = measured.ci95
            inform(f"  {label}: {measured.value:.5g} {unit} (95 %: {low:.5g} to {high:.5g})")
    if record.fit:
        _inform_of_fit(record.fit)
    counts = {kind: len(getattr(record, f"{kind}_pixels")) for kind in ("hot", "noisy", "dead")}
    inform("  pixels: " + ", ".join(f"{count} {kind}" for kind, count in counts.items()))
    for warning in record.warnings:
        inform(f"  warning: {warning}")


def _inform_of_fit(fit: FitRecord) -> None:
    """Print what the flats say of saturation and response, as far as they do."""
    saturation, error = fit.saturation, fit.linearity_error
    if saturation.level_dn is not None:
        capacity = "" if fit.saturation_e.value is None else f", mu_e.sat {fit.saturation_e.value:.4g} e⁻"
        inform(f"  saturation: {saturation.level_dn:.5g} DN ({saturation.limit}){capacity}")
    if error.value is not None and error.ci95 is not None:
        low, high = error.ci95
        inform(f"  LE, linearity error: {error.value:.3%} (95 %: {low:.3%} to {high:.3%})")
