"""`faintfield simulate`: an elemental set of a synthetic scene with its ground truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.arguments import Count, NotNegative, Positive, Seed, SizePx
from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.files import building_folder, write_json
from faintfield.pipelines.formats.image_files import mask_picture, write_frame, write_plane, write_png
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.records import Poses
from faintfield.pipelines.formats.sets.elemental_file import Camera, ElementalSetFile, Noise, View, write_set
from faintfield.pipelines.formats.sets.ground_truth import TRUTH_FILE, TruePlane, Truth
from faintfield.pipelines.reconstruction.object_region import OBJECT_REGION
from faintfield.pipelines.simulation.exposures import stated_noise, write_exposures
from faintfield.recon.metrics import (
    expected_snr_from_powers,
    photons_from_linear_snr,
    photons_from_moments,
    signal_scale_for_snr,
)
from faintfield.rig.grid import grid_nodes
from faintfield.rig.simulation.experiment import SimulatedExperiment, paper_experiment
from faintfield.rig.simulation.scene import TexturedPlane, render
from faintfield.rig.simulation.sensor import through_mosaic

NOISE_FREE = "noise_free"

# The noise-free set spans this much of its 16 bits, so that rounding is below a ten-thousandth of its peak.
_NOISE_FREE_PEAK_DN = 60000.0


@dataclass(frozen=True)
class _Rendered:
    """All that light does, before the sensor: relative units, where 1 is a white object on the axis."""

    poses_rt_cam_ref: NDArray[np.float64]
    views: NDArray[np.float32]
    object_region: NDArray[np.bool_]


def simulate(
    out: Path,
    /,
    *,
    snr: Positive = 0.16,
    seed: Seed = 1,
    rows: Count = 7,
    columns: Count = 7,
    pitch_mm: Positive = 50.0,
    size_px: SizePx = (640, 480),
    exposure_s: Positive = 0.1,
    position_error_mm: NotNegative = 0.3,
    rotation_error_mrad: NotNegative = 3.5,
    poses: Literal["true", "nominal"] = "true",
    colour: Literal["grey", "bayer"] = "grey",
    overwrite: bool = False,
) -> dict[str, Any]:
    """Simulate the paper's experiment: a toy truck at 500 mm and a toy airplane at 700 mm, almost dark.

    Writes the dark-scene set, a noise-reference image, the same views without noise (`noise_free`, a set of its own),
    and the ground truth: textures, where they are visible, the poses.

    Parameters
    ----------
    out
        Folder to write.
    snr
        Of eq. (4) over the object region of the reference view; the light is set accordingly.
    seed
        Of all chance.
    rows
        Of the grid's nodes.
    columns
        Of the grid's nodes.
    pitch_mm
        Distance of neighbouring nodes.
    size_px
        Width and height of the detector.
    exposure_s
        Of each view.
    position_error_mm
        Standard deviation of each axis of each node's position, except the centre's.
    rotation_error_mrad
        The same of its rotation.
    poses
        What elemental.toml states: the poses the camera really had, or those it was sent to.
    colour
        A sensor without colour filters, or with a Bayer mosaic.
    overwrite
        Replace an earlier set in OUT.
    """
    options = {name: value for name, value in locals().items() if name not in ("out", "overwrite")}
    experiment = _experiment(rows, columns, pitch_mm, size_px, exposure_s)
    generator = np.random.default_rng(seed)
    mosaic = ("RG", "GB") if colour == "bayer" else None
    with building_folder(out, replace_if="elemental.toml" if overwrite else None) as folder:
        errors = (position_error_mm, rotation_error_mrad * 1e-3)
        rendered = _render(experiment, experiment.poses_rt_cam_ref(*errors, generator), mosaic)
        sensor = experiment.sensor
        dark_e = sensor.dark_current_e_per_s * exposure_s
        if not rendered.object_region.any():
            raise BadValue(f"--size-px {size_px[0]} {size_px[1]}: the objects cover no pixel; give more pixels")
        scale = signal_scale_for_snr(
            rendered.views[experiment.reference_view][rendered.object_region], snr, dark_e, sensor.read_noise_e
        )
        stated = rendered.poses_rt_cam_ref if poses == "true" else experiment.nominal_poses_rt_cam_ref()
        _write_dark_set(folder, experiment, rendered, scale, stated, mosaic, generator)
        _write_noise_free_set(folder / NOISE_FREE, experiment, rendered, scale, mosaic)
        truth = _write_truth(folder, experiment, rendered, scale, snr, poses, mosaic)
        write_json(folder / "provenance.json", provenance("simulate", options, {}))
    inform(
        f"{out}: {rows} x {columns} views, SNR {truth.snr:.3f}; photons per pixel on the object: "
        f"{truth.photons_from_moments:.2f} (moments), {truth.photons_linear:.2f} (the paper's linear formula)"
    )
    shown = ("snr", "photons_linear", "photons_from_moments", "photons_on_object")
    return {"out": str(out), "views": rows * columns} | {name: getattr(truth, name) for name in shown}


def write_ground_truth(
    folder: Path,
    experiment: SimulatedExperiment,
    poses_rt_cam_ref: NDArray[np.float64],
    white_e: float,
    snr: float,
    mosaic: tuple[str, ...] | None,
) -> Truth:
    """Write beside a capture of the simulated world what it cannot show: its views without noise, and the truth.

    Parameters
    ----------
    folder : Path
        Folder to write, which exists.
    experiment : SimulatedExperiment
        The camera, and what stands before it.
    poses_rt_cam_ref : array (view, 6)
        Where the camera really was, in raster order.
    white_e : float
        Expected electrons of a white object on the axis.
    snr : float
        That was asked for.
    mosaic : tuple of str, optional
        Colour filters.
    """
    rendered = _render(experiment, poses_rt_cam_ref, mosaic, samples_per_px=1)  # as the simulated camera does
    _write_noise_free_set(folder / NOISE_FREE, experiment, rendered, white_e, mosaic)
    return _write_truth(folder, experiment, rendered, white_e, snr, "true", mosaic)


def _experiment(
    rows: int, columns: int, pitch_mm: float, size_px: tuple[int, int], exposure_s: float
) -> SimulatedExperiment:
    """Return the paper's experiment with the grid and detector asked for."""
    paper = paper_experiment(*size_px)
    return SimulatedExperiment(paper.planes, paper.optics, paper.sensor, rows, columns, pitch_mm, exposure_s)


def _render(
    experiment: SimulatedExperiment,
    poses: NDArray[np.float64],
    mosaic: tuple[str, ...] | None,
    samples_per_px: int = 2,
) -> _Rendered:
    """Cast the rays of all views; through a mosaic each pixel keeps the colour of its filter."""
    planes = [plane if mosaic else plane.grey() for plane in experiment.planes]
    views = np.empty((len(poses), *experiment.optics.size_px[::-1]), np.float32)
    object_region = np.zeros(views.shape[1:], bool)
    rendering = render(planes, experiment.optics, poses, samples_per_px=samples_per_px)
    for index, view in enumerate(progress(rendering, "rendering views", len(poses))):
        views[index] = view.light if mosaic is None else through_mosaic(view.light, mosaic)
        if index == experiment.reference_view:
            object_region = np.sum(list(view.visible.values()), axis=0) > 0.5
    return _Rendered(poses, views, object_region)


def _write_dark_set(
    folder: Path,
    experiment: SimulatedExperiment,
    rendered: _Rendered,
    scale_e: float,
    poses: NDArray[np.float64],
    mosaic: tuple[str, ...] | None,
    generator: np.random.Generator,
) -> None:
    """Expose every view, and once nothing, and write the set."""
    sensor = experiment.sensor
    nodes = grid_nodes(experiment.rows, experiment.columns)
    names = [f"view_r{row}_c{column}.tiff" for row, column in nodes]
    signal_e = (light * scale_e for light in rendered.views)
    write_exposures(folder, names, signal_e, sensor, experiment.exposure_s, generator)
    _write_toml(folder, experiment, names, poses, stated_noise(sensor), mosaic)


def _write_noise_free_set(
    folder: Path, experiment: SimulatedExperiment, rendered: _Rendered, scale_e: float, mosaic: tuple[str, ...] | None
) -> None:
    """Write the expected electrons of every view, with the true poses, as a set that saturates nowhere."""
    folder.mkdir()
    gain_dn_per_e = _NOISE_FREE_PEAK_DN / (float(rendered.views.max()) * scale_e)
    names = [f"view_r{row}_c{column}.tiff" for row, column in grid_nodes(experiment.rows, experiment.columns)]
    for name, light in zip(names, rendered.views, strict=True):
        write_frame(folder / name, np.rint(light * (scale_e * gain_dn_per_e)).astype(np.uint16))
    noise = Noise(offset_dn=0.0, gain_dn_per_e=gain_dn_per_e, read_noise_e=0.0, saturation_dn=65535.0)
    _write_toml(folder, experiment, names, rendered.poses_rt_cam_ref, noise, mosaic)


def _write_toml(
    folder: Path,
    experiment: SimulatedExperiment,
    names: list[str],
    poses: NDArray[np.float64],
    noise: Noise,
    mosaic: tuple[str, ...] | None,
) -> None:
    """Write the flat field and `elemental.toml`."""
    optics = experiment.optics
    write_plane(folder / "flat.tiff", optics.relative_illumination(), pitch_mm=1.0)
    camera = Camera(
        optics.size_px, optics.fx_px, optics.fy_px, optics.cx_px, optics.cy_px, optics.distortion, mosaic, "flat.tiff"
    )
    nodes = grid_nodes(experiment.rows, experiment.columns)
    views = [View(name, tuple(pose.tolist()), node) for name, pose, node in zip(names, poses, nodes, strict=True)]
    write_set(folder, ElementalSetFile(1, experiment.exposure_s, experiment.reference_view, camera, noise, views))


def _write_truth(
    folder: Path,
    experiment: SimulatedExperiment,
    rendered: _Rendered,
    scale_e: float,
    snr: float,
    poses: Poses,
    mosaic: tuple[str, ...] | None,
) -> Truth:
    """Write what only the simulator knows, and return it."""
    sensor = experiment.sensor
    here = np.zeros((1, 6))
    all_visible = next(render([plane.grey() for plane in experiment.planes], experiment.optics.ideal(), here)).visible
    planes = []
    for plane in experiment.planes:
        texture = _texture(plane if mosaic else plane.grey(), experiment) * scale_e
        names = [
            f"truth/{kind}_{plane.depth_mm:07.1f}.{suffix}" for kind, suffix in (("plane", "tiff"), ("visible", "png"))
        ]
        write_plane(folder / names[0], texture, plane.depth_mm / experiment.optics.fx_px)
        write_png(folder / names[1], mask_picture(all_visible[plane.name] > 0.5))
        planes.append(TruePlane(plane.name, plane.depth_mm, names[0], names[1]))
    write_png(folder / OBJECT_REGION, mask_picture(rendered.object_region))
    signal_e = rendered.views[experiment.reference_view][rendered.object_region] * scale_e
    dark_e = sensor.dark_current_e_per_s * experiment.exposure_s
    known = {"quantum_efficiency": sensor.quantum_efficiency, "read_noise_e": sensor.read_noise_e}
    truth = Truth(
        snr=expected_snr_from_powers(signal_e, dark_e, sensor.read_noise_e),
        photons_linear=photons_from_linear_snr(snr, **known),
        photons_from_moments=photons_from_moments(snr, dark_e=dark_e, **known),
        photons_on_object=float(signal_e.mean()) / sensor.quantum_efficiency,
        noise_free=NOISE_FREE,
        poses=poses,
        true_rt_cam_ref=[tuple(pose) for pose in rendered.poses_rt_cam_ref.tolist()],
        planes=planes,
    )
    write_json(folder / TRUTH_FILE, truth)
    return truth


def _texture(plane: TexturedPlane, experiment: SimulatedExperiment) -> NDArray[np.float32]:
    """Return one object alone, as a pinhole at the reference node sees it: the plane that would be reconstructed."""
    return next(render([plane], experiment.optics.ideal(), np.zeros((1, 6)))).light
