"""The elemental set of a synthetic scene with its ground truth, and the exposures of a simulated sensor."""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.console import progress
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.files import check_free, require_room, write_json, writing_folder
from faintfield.pipelines.formats.image_files import (
    ONE_PIXEL,
    Spacing,
    mask_picture,
    write_frame,
    write_plane,
    write_png,
)
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.records import Poses
from faintfield.pipelines.formats.sets.elemental_file import FILE_NAME, Camera, ElementalSetFile, Noise, View, write_set
from faintfield.pipelines.formats.sets.elemental_set import NOISE_REFERENCE
from faintfield.pipelines.formats.sets.ground_truth import TRUTH_FILE, TruePlane, TrueSurface, Truth
from faintfield.pipelines.reconstruction.overview import OBJECT_REGION
from faintfield.pipelines.simulation.options import SyntheticOptions
from faintfield.recon.metrics import (
    expected_snr_from_powers,
    photons_from_linear_snr,
    photons_from_moments,
    signal_scale_for_snr,
)
from faintfield.rig.plan import grid_nodes
from faintfield.rig.simulation.experiment import SimulatedExperiment, paper_experiment, surface_experiment
from faintfield.rig.simulation.optics import SimulatedOptics, SimulatedSensor, through_mosaic
from faintfield.rig.simulation.scene import render
from faintfield.rig.simulation.surfaces import true_depth_mm

NOISE_FREE = "noise_free"

_FLAT = "flat.tiff"

# The brightest pixel of the noise-free set, of 65535: rounding stays below a ten-thousandth of it.
_NOISE_FREE_PEAK_DN = 60000.0


def write_synthetic_set(out: Path, options: SyntheticOptions, *, overwrite: bool = False) -> Truth:
    """Write the dark set of an experiment, the same set without noise, and its ground truth; return that."""
    generator = np.random.default_rng(options.seed)
    experiment = _experiment(options)
    sensor = experiment.sensor
    dark_e = sensor.dark_current_e_per_s * options.exposure_s
    check_free(out, replace_if=FILE_NAME, overwrite=overwrite)
    # Each view twice: as captured, and without noise
    views, pixels = options.rows * options.columns, math.prod(options.size_px)
    size_bytes = 2 * views * pixels * np.dtype(np.uint16).itemsize
    require_room(out, size_bytes, written_bytes=size_bytes)
    with writing_folder(out, replace_if=FILE_NAME, overwrite=overwrite) as folder:
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
        recorded = asdict(options)
        for name, once_the_only in (("objects", "toys"), ("lens", "real")):
            if recorded[name] == once_the_only:
                del recorded[name]
        write_json(folder / "provenance.json", provenance("simulate", recorded, {}))
    return truth


def _experiment(options: SyntheticOptions) -> SimulatedExperiment:
    made = surface_experiment if options.objects == "surfaces" else paper_experiment
    experiment = made(*options.size_px)
    return replace(
        experiment,
        optics=_centred(experiment.optics) if options.lens == "ideal" else experiment.optics,
        rows=options.rows,
        columns=options.columns,
        pitch_mm=options.pitch_mm,
        exposure_s=options.exposure_s,
    )


def _centred(optics: SimulatedOptics) -> SimulatedOptics:
    """Return the optics without distortion and vignetting, their principal point in the middle."""
    width, height = optics.size_px
    return replace(optics.ideal(), cx_px=(width - 1) / 2, cy_px=(height - 1) / 2)


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
    """Write each view (row, column) of expected photoelectrons under its name, exposed; one without light is added."""
    for name, view_e in zip(names, signal_e, strict=True):
        write_frame(folder / name, sensor.expose(view_e / sensor.quantum_efficiency, exposure_s, generator))
    write_frame(folder / NOISE_REFERENCE, sensor.expose(np.zeros_like(view_e), exposure_s, generator))


@dataclass(frozen=True)
class RenderedScene:
    """A simulated scene as light alone makes it, before the sensor.

    `poses_rt_cam_ref` (view, 6) are where the camera really is, in raster order. `views` (view, row, column) are
    relative to the light of a white object on the axis; `object_region` is where the reference view shows an object.
    """

    experiment: SimulatedExperiment
    mosaic: tuple[str, ...] | None
    poses_rt_cam_ref: NDArray[np.float64]
    views: NDArray[np.float32]
    object_region: NDArray[np.bool_]

    @property
    def reference_light(self) -> NDArray[np.float32]:
        """The pixels (count,) of the reference view that show an object."""
        return np.asarray(self.views[self.experiment.reference_view][self.object_region])

    @property
    def view_names(self) -> list[str]:
        """The file name of each view."""
        return [f"view_r{row}_c{column}.tiff" for row, column in self._nodes]

    @property
    def _nodes(self) -> list[tuple[int, int]]:
        return grid_nodes(self.experiment.rows, self.experiment.columns)

    def write_settings(self, folder: Path, poses_rt_cam_ref: NDArray[np.float64], noise: Noise) -> None:
        """Write the flat field and `elemental.toml`, which states the poses and the noise given."""
        optics = self.experiment.optics
        write_plane(folder / _FLAT, optics.relative_illumination(), ONE_PIXEL)
        lens = (optics.fx_px, optics.fy_px, optics.cx_px, optics.cy_px, optics.distortion)
        camera = Camera(optics.size_px, *lens, self.mosaic, _FLAT)
        entries = zip(self.view_names, poses_rt_cam_ref, self._nodes, strict=True)
        views = [View(name, tuple(pose.tolist()), node) for name, pose, node in entries]
        settings = ElementalSetFile(
            format=1,
            exposure_s=self.experiment.exposure_s,
            reference_view=self.experiment.reference_view,
            camera=camera,
            noise=noise,
            view=views,
        )
        write_set(folder, settings)


def render_scene(
    experiment: SimulatedExperiment,
    poses_rt_cam_ref: NDArray[np.float64],
    mosaic: tuple[str, ...] | None,
    samples_per_px: int = 2,
) -> RenderedScene:
    """Cast rays of all views, `samples_per_px` along each side; through a mosaic, a pixel keeps its filter's colour."""
    views = np.empty((len(poses_rt_cam_ref), *experiment.optics.size_px[::-1]), np.float32)
    object_region = np.zeros(views.shape[1:], bool)
    coloured = experiment if mosaic else experiment.grey()
    rendering = coloured.render(poses_rt_cam_ref, samples_per_px=samples_per_px)
    for index, view in enumerate(progress(rendering, "rendering views", len(poses_rt_cam_ref))):
        views[index] = view.light if mosaic is None else through_mosaic(view.light, mosaic)
        if index == experiment.reference_view:
            object_region = np.sum(list(view.visible.values()), axis=0) > 0.5
    return RenderedScene(experiment, mosaic, poses_rt_cam_ref, views, object_region)


def write_ground_truth(folder: Path, scene: RenderedScene, white_e: float, snr: float, poses: Poses = "true") -> Truth:
    """Write the noise-free views, as a set of their own, and everything else that no capture shows.

    `white_e` are the expected electrons of a white object on the axis; `poses` are those that the captured set states.
    """
    _write_noise_free_set(folder / NOISE_FREE, scene, white_e)
    write_png(folder / OBJECT_REGION, mask_picture(scene.object_region))
    sensor = scene.experiment.sensor
    signal_e = scene.reference_light * white_e
    dark_e = sensor.dark_current_e_per_s * scene.experiment.exposure_s
    known = {"quantum_efficiency": sensor.quantum_efficiency, "read_noise_e": sensor.read_noise_e}
    truth = Truth(
        snr=expected_snr_from_powers(signal_e, dark_e, sensor.read_noise_e),
        photons_linear=photons_from_linear_snr(snr, **known),
        photons_from_moments=photons_from_moments(snr, dark_e=dark_e, **known),
        photons_on_object=float(signal_e.mean()) / sensor.quantum_efficiency,
        noise_free=NOISE_FREE,
        poses=poses,
        true_rt_cam_ref=[tuple(pose) for pose in scene.poses_rt_cam_ref.tolist()],
        planes=_write_textures(folder, scene, white_e) if scene.experiment.planes else [],
        surface=_write_surface(folder, scene, white_e) if scene.experiment.surfaces else None,
    )
    write_json(folder / TRUTH_FILE, truth)
    return truth


def _write_noise_free_set(folder: Path, scene: RenderedScene, white_e: float) -> None:
    """Write the expected electrons of every view, with the true poses, as a set that saturates nowhere."""
    folder.mkdir()
    gain_dn_per_e = _NOISE_FREE_PEAK_DN / (float(scene.views.max()) * white_e)
    for name, light in zip(scene.view_names, scene.views, strict=True):
        write_frame(folder / name, np.rint(light * (white_e * gain_dn_per_e)).astype(np.uint16))
    noise = Noise(offset_dn=0.0, gain_dn_per_e=gain_dn_per_e, read_noise_e=0.0, saturation_dn=65535.0)
    scene.write_settings(folder, scene.poses_rt_cam_ref, noise)


def _write_textures(folder: Path, scene: RenderedScene, white_e: float) -> list[TruePlane]:
    planes, optics = scene.experiment.planes, scene.experiment.optics
    seen_by_ideal = partial(render, optics=optics.ideal(), poses_rt_cam_ref=np.zeros((1, 6)))
    all_visible = next(seen_by_ideal([plane.grey() for plane in planes])).visible
    entries = []
    for plane in planes:
        texture = f"truth/plane_{plane.depth_mm:07.1f}.tiff"
        visible = f"truth/visible_{plane.depth_mm:07.1f}.png"
        light = next(seen_by_ideal([plane if scene.mosaic else plane.grey()])).light
        write_plane(folder / texture, light * white_e, Spacing(plane.depth_mm / optics.fx_px))
        write_png(folder / visible, mask_picture(all_visible[plane.name] > 0.5))
        entries.append(TruePlane(plane.name, plane.depth_mm, texture, visible))
    return entries


def _write_surface(folder: Path, scene: RenderedScene, white_e: float) -> TrueSurface:
    coloured = scene.experiment if scene.mosaic else scene.experiment.grey()
    ideal = replace(coloured, optics=coloured.optics.ideal())
    surface = TrueSurface("truth/true_depth_mm.tiff", "truth/true_picture.tiff")
    write_plane(folder / surface.depth_mm, true_depth_mm(ideal.surfaces, ideal.optics), ONE_PIXEL)
    write_plane(folder / surface.picture, next(ideal.render(np.zeros((1, 6)))).light * white_e, ONE_PIXEL)
    return surface
