"""A sensor measured from dark and flat frames, with its page; two measurements compared: `faintfield noise`."""

from pathlib import Path

from faintfield.calib.estimate import Estimate
from faintfield.calib.noise.strips import maps_by
from faintfield.pipelines.calibration.noise import calibrate_sensor
from faintfield.pipelines.calibration.noise_comparison import CHANCE, NoiseComparison, compare_noise, label
from faintfield.pipelines.calibration.noise_record import noise_maps, noise_record
from faintfield.pipelines.console import inform, working
from faintfield.pipelines.formats.files import check_results_folder, removed_if_empty
from faintfield.pipelines.formats.large_arrays import maps_in_files
from faintfield.pipelines.formats.results.noise import NOISE_FILE, STANDARD, FitRecord, NoiseRecord, write_noise
from faintfield.pipelines.formats.sets.noise_set import load_noise_set
from faintfield.pipelines.pages.noise_page import noise_page

_SHOWN = (
    ("gain_dn_per_e", "K, system gain", "DN/e⁻"),
    ("offset_dn", "mu_y.dark(0), offset", "DN"),
    ("read_noise_e", "sigma_d, read noise", "e⁻"),
    ("dark_current_e_per_s", "mu_I, dark current", "e⁻/s"),
    ("dsnu_e", "DSNU (pixel)", "e⁻"),
    ("prnu", "PRNU", ""),
    ("quantum_efficiency", "eta, quantum efficiency", "e⁻/photon"),
)


def measure_sensor(folder: Path, out: Path | None = None) -> NoiseRecord:
    """Measure a sensor from the frames in a folder, and write the result with its page, there if not to `out`."""
    frames = load_noise_set(folder)
    out, title = out or frames.folder, frames.folder.resolve().name
    check_results_folder(out)
    with removed_if_empty(out), maps_by(maps_in_files(out)):
        sensor = calibrate_sensor(frames)
        record = noise_record(sensor)
        with working("drawing the page"):
            page = noise_page(title, record, sensor)
        record = write_noise(out, record, noise_maps(sensor), page)
    _inform_of(record)
    inform(f"{out / NOISE_FILE}")
    return record


def _inform_of(record: NoiseRecord) -> None:
    """Print the main numbers and every warning; a reason that holds for several numbers is given once."""
    inform(f"{STANDARD}; likelihood: {record.likelihood}")
    explained: dict[str, str] = {}
    for name, title, unit in _SHOWN:
        measured: Estimate = getattr(record, name)
        if measured.value is None or measured.ci95 is None:
            reason = measured.why or ""
            inform(f"  {title}: not identifiable: {'as for ' + explained[reason] if reason in explained else reason}")
            explained.setdefault(reason, title.partition(",")[0])
        else:
            low, high = measured.ci95
            inform(f"  {title}: {measured.value:.5g} {unit} (95 %: {low:.5g} to {high:.5g})")
    if record.fit:
        _inform_of_fit(record.fit)
    counts = {kind: len(getattr(record, f"{kind}_pixels")) for kind in ("hot", "noisy", "dead")}
    inform("  pixels: " + ", ".join(f"{count} {kind}" for kind, count in counts.items()))
    for warning in record.warnings:
        inform(f"  warning: {warning}")


def _inform_of_fit(fit: FitRecord) -> None:
    saturation, error = fit.saturation, fit.linearity_error
    if saturation.level_dn is not None:
        full, capacity = fit.saturation_e, ""
        if full.value is not None and full.ci95 is not None:
            capacity = f", mu_e.sat {full.value:.5g} e⁻ (95 %: {full.ci95[0]:.5g} to {full.ci95[1]:.5g})"
        inform(f"  saturation: {saturation.level_dn:.5g} DN ({saturation.limit}){capacity}")
    if error.value is not None and error.ci95 is not None:
        low, high = error.ci95
        inform(f"  LE, linearity error: {error.value:.3%} (95 %: {low:.3%} to {high:.3%})")


def compare_sensors(first: Path, second: Path) -> NoiseComparison:
    """Compare two measurements, and print a table of the quantities, and what is known of pixels and maps."""
    comparison = compare_noise(first, second)
    inform(f"A: {comparison.first}")
    inform(f"B: {comparison.second}")
    quantities = comparison.quantities
    wide = max(len(label(change)) for change in quantities)
    inform(f"{'':{wide}}  {'A':>12} {'B':>12} {'B - A':>12} {'in sigma':>9}  verdict")
    for change in quantities:
        numbers = " ".join(
            "-".rjust(12) if n is None else f"{n:12.5g}" for n in (change.first, change.second, change.difference)
        )
        sigma = "-" if change.sigma is None else f"{change.sigma:+.1f}"
        inform(
            f"{label(change):{wide}}  {numbers} {sigma:>9}  {change.verdict}{f': {change.why}' if change.why else ''}"
        )
    for count in comparison.pixels:
        inform(
            f"{count.kind} pixels: {count.both} in both, {count.only_first} in A only, {count.only_second} in B only"
        )
    for difference in comparison.maps:
        if difference.rms_dn is None or difference.expected_dn is None:
            inform(f"{label(difference)}: {difference.verdict}: {difference.why}")
        else:
            differs = f"differs by {difference.rms_dn:.4g} DN rms, expected {difference.expected_dn:.4g} DN"
            inform(f"{label(difference)}: {differs}: {difference.verdict}")
    for note in comparison.notes:
        inform(f"note: {note}")
    changed = ", ".join(comparison.changed) or "nothing"
    inform(
        f"changed: {changed} (beyond {comparison.limit_sigma:.1f} sigma, so that {CHANCE:.0%} of "
        f"{comparison.comparisons} comparisons together are false alarms)"
    )
    return comparison
