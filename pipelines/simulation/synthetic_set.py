"""The elemental set of a synthetic scene with its ground truth, and the exposures of a simulated sensor."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.files import write_json, writing_folder
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.sets.elemental_file import FILE_NAME, Noise
from faintfield.pipelines.formats.sets.elemental_set import NOISE_REFERENCE
from faintfield.pipelines.formats.sets.ground_truth import Truth
from faintfield.pipelines.simulation.scene_truth import render_scene, write_ground_truth
from faintfield.recon.metrics import signal_scale_for_snr
from faintfield.rig.simulation.experiment import SimulatedExperiment, paper_experiment
from faintfield.rig.simulation.sensor import SimulatedSensor


class SyntheticOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of `faintfield simulate`, as its help explains them and provenance.json records them."""

    snr: float = 0.16
    seed: int = 1
    rows: int = 7
    columns: int = 7
    pitch_mm: float = 50.0
    size_px: tuple[int, int] = (640, 480)
    exposure_s: float = 0.1
    position_error_mm: float = 0.3
    rotation_error_mrad: float = 3.5
    poses: Literal["true", "nominal"] = "true"
    colour: Literal["grey", "bayer"] = "grey"


def write_synthetic_set(out: Path, options: SyntheticOptions, *, overwrite: bool = False) -> Truth:
    """Write the dark set of the paper's experiment, the same set without noise, and its ground truth; return that.

    Raises
    ------
    OutputExists
        `out` holds something other than an earlier set, or `overwrite` is False.
    BadValue
        The detector is too small to show the objects.
    """
    generator = np.random.default_rng(options.seed)
    paper = paper_experiment(*options.size_px)
    grid = (options.rows, options.columns, options.pitch_mm)
    experiment = SimulatedExperiment(paper.planes, paper.optics, paper.sensor, *grid, options.exposure_s)
    sensor = paper.sensor
    dark_e = sensor.dark_current_e_per_s * options.exposure_s
    with writing_folder(out, replace_if=FILE_NAME if overwrite else None) as folder:
        true = experiment.poses_rt_cam_ref(options.position_error_mm, options.rotation_error_mrad * 1e-3, generator)
        scene = render_scene(experiment, true, ("RG", "GB") if options.colour == "bayer" else None)
        if not scene.object_region.any():
            width, height = options.size_px
            raise BadValue(f"--size-px {width} {height}: the objects cover no pixel; give more pixels")
        white_e = signal_scale_for_snr(scene.reference_light, options.snr, dark_e, sensor.read_noise_e)
        signal_e = (light * white_e for light in scene.views)
        write_exposures(folder, scene.view_names, signal_e, sensor, options.exposure_s, generator)
        stated = true if options.poses == "true" else experiment.nominal_poses_rt_cam_ref()
        scene.write_settings(folder, stated, stated_noise(sensor))
        truth = write_ground_truth(folder, scene, white_e, options.snr, options.poses)
        write_json(folder / "provenance.json", provenance("simulate", options, {}))
    return truth


def stated_noise(sensor: SimulatedSensor) -> Noise:
    """Return the `[noise]` table of a set taken with a sensor."""
    return Noise(
        gain_dn_per_e=sensor.gain_dn_per_e,
        read_noise_e=sensor.read_noise_e,
        offset_dn=sensor.offset_dn,
        dark_current_e_per_s=sensor.dark_current_e_per_s,
        quantum_efficiency=sensor.quantum_efficiency,
        saturation_dn=float(sensor.saturation_dn),
    )


def write_exposures(
    folder: Path,
    names: Iterable[str],
    signal_e: Iterable[NDArray[np.floating]],
    sensor: SimulatedSensor,
    exposure_s: float,
    generator: np.random.Generator,
) -> None:
    """Expose every view and write it under its name; an exposure without light is the noise reference.

    Parameters
    ----------
    signal_e : iterable of array (row, column)
        Expected photoelectrons of each view.
    """
    for name, view_e in zip(names, signal_e, strict=True):
        write_frame(folder / name, sensor.expose(view_e / sensor.quantum_efficiency, exposure_s, generator))
    write_frame(folder / NOISE_REFERENCE, sensor.expose(np.zeros_like(view_e), exposure_s, generator))
