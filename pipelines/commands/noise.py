"""`faintfield noise`: a sensor measured from dark and flat frames."""

from pathlib import Path
from typing import TYPE_CHECKING, overload

from faintfield.pipelines.errors import WrongUsage

if TYPE_CHECKING:
    from faintfield.pipelines.calibration.noise_comparison import NoiseComparison
    from faintfield.pipelines.formats.results.noise import NoiseRecord

type Result = NoiseRecord | NoiseComparison


@overload
def noise(folder: Path, /, *, out: Path | None = None) -> "NoiseRecord": ...
@overload
def noise(*, compare: tuple[Path, Path]) -> "NoiseComparison": ...
def noise(
    folder: Path | None = None, /, *, out: Path | None = None, compare: tuple[Path, Path] | None = None
) -> Result:
    """Measure offset, gain, read noise and dark current from dark frames, and flats if there are any.

    Writes noise.json (numbers with 95 % intervals, or why there are none), noise_maps.npz (per pixel), a page of
    plots, noise_page.png, and the report by EMVA 1288, emva1288_report.html. With --compare instead of FOLDER: tells
    whether a camera has changed from one measurement to another, and writes nothing.

    Parameters
    ----------
    folder
        A session with dark frames, or a folder with noise.toml and the frames that it names.
    out
        Where to write; FOLDER itself if not given.
    compare
        Two results of this command, noise.json or their folders: the earlier and the later one.
    """
    from faintfield.pipelines.workflows.noise import compare_sensors, measure_sensor

    if compare is not None:
        if folder is not None or out is not None:
            raise WrongUsage("--compare takes two results and writes nothing; leave out FOLDER and --out")
        return compare_sensors(*compare)
    if folder is None:
        raise WrongUsage("nothing to measure is named; give a FOLDER with frames, or two results with --compare A B")
    return measure_sensor(folder, out)
