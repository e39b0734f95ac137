"""The paper's experiment: toys, a grid of nodes, a lens and a cooled 16-bit sensor; and the same with surfaces."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from faintfield.rig.plan import centre_node, nominal_poses_rt_cam_ref
from faintfield.rig.simulation.objects import surface_scene, toy_airplane, toy_truck
from faintfield.rig.simulation.optics import SimulatedOptics, SimulatedSensor
from faintfield.rig.simulation.scene import RenderedView, TexturedPlane, render
from faintfield.rig.simulation.surfaces import Surface, render_surfaces


@dataclass(frozen=True)
class SimulatedExperiment:
    """A scene of planes before a black background, or of surfaces, a camera and a grid of nodes.

    `exposure_s` is the exposure time of one view of the dark scene.
    """

    planes: tuple[TexturedPlane, ...]
    optics: SimulatedOptics
    sensor: SimulatedSensor = field(default_factory=SimulatedSensor)
    rows: int = 7
    columns: int = 7
    pitch_mm: float = 50.0
    exposure_s: float = 0.1
    surfaces: tuple[Surface, ...] = ()

    @property
    def reference_view(self) -> int:
        """Index of the view at the centre node, in raster order."""
        row, column = centre_node(self.rows, self.columns)
        return row * self.columns + column

    def nominal_poses_rt_cam_ref(self) -> NDArray[np.float64]:
        """Return the poses (view, 6) of the nodes."""
        return nominal_poses_rt_cam_ref(self.rows, self.columns, self.pitch_mm)

    def poses_rt_cam_ref(
        self, position_sd_mm: float, rotation_sd_rad: float, generator: np.random.Generator
    ) -> NDArray[np.float64]:
        """Return the poses (view, 6) with normal errors of each axis, but none at the reference view."""
        poses = self.nominal_poses_rt_cam_ref()
        errors = generator.normal(size=poses.shape) * np.repeat([rotation_sd_rad, position_sd_mm], 3)
        errors[self.reference_view] = 0
        return np.asarray(poses + errors)

    def render(self, poses_rt_cam_ref: NDArray[np.float64], *, samples_per_px: int = 2) -> Iterator[RenderedView]:
        """Yield the view of each pose (view, 6), see `scene.render` and `surfaces.render_surfaces`."""
        if self.surfaces:
            return render_surfaces(self.surfaces, self.optics, poses_rt_cam_ref, samples_per_px=samples_per_px)
        return render(self.planes, self.optics, poses_rt_cam_ref, samples_per_px=samples_per_px)

    def grey(self) -> "SimulatedExperiment":
        """Return the experiment as a sensor without colour filters sees it."""
        planes = tuple(plane.grey() for plane in self.planes)
        return replace(self, planes=planes, surfaces=tuple(surface.grey() for surface in self.surfaces))


def paper_experiment(width_px: int = 640, height_px: int = 480) -> SimulatedExperiment:
    """Return the paper's scene: a toy truck at 500 mm and a toy airplane at 700 mm."""
    planes = (toy_truck(-62.0, 50.0, 500.0), toy_airplane(78.0, -55.0, 700.0))
    return SimulatedExperiment(planes, _paper_optics(width_px, height_px))


def surface_experiment(width_px: int = 640, height_px: int = 480) -> SimulatedExperiment:
    """Return the paper's camera and grid before a scene of slanted, curved and thin objects that fills its views."""
    return SimulatedExperiment((), _paper_optics(width_px, height_px), surfaces=surface_scene())


def _paper_optics(width_px: int, height_px: int) -> SimulatedOptics:
    """Return the paper's lens: the view of 800 px focal length at 640 px width, slight distortion, off centre."""
    f_px = 800.0 * width_px / 640.0
    return SimulatedOptics(
        size_px=(width_px, height_px),
        fx_px=f_px,
        fy_px=f_px,
        cx_px=(width_px - 1) / 2 + 0.006 * width_px,
        cy_px=(height_px - 1) / 2 - 0.004 * height_px,
        distortion=(-0.08, 0.02, 0.0005, -0.0003, 0.0),
    )
