"""Cameras at several poses before a plane, drawn by hypothesis, for the tests of the operator."""

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, plane_from_ray
from faintfield.calib.lens import Lens
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.single_plane import PlaneOperator

DISTORTIONS: list[tuple[float, ...]] = [
    (),
    (-0.15, 0.04, 1e-3, -5e-4, 0.01),
    (0.2, -0.1, -1e-3, 2e-3, 0.02, 0.3, -0.05, 0.01),
]
MOSAIC_PHASES = [(0, 0), (0, 1), (1, 0), (1, 1)]
FACING_AT_500_MM = fronto_parallel_rt_ref_plane(500.0)


@dataclass(frozen=True)
class Case:
    """A camera at several poses before a plane."""

    rays: NDArray[np.floating]  # (lattice, row, column, 2)
    rt_cam_ref: NDArray[np.float64]
    rt_ref_plane: NDArray[np.float64]
    grid: PlaneGrid
    flat: NDArray[np.float64]  # (lattice, row, column)
    valid: NDArray[np.bool_]
    lattice_of_view: NDArray[np.intp]
    workers: int

    def operator(self) -> PlaneOperator:
        return PlaneOperator(
            plane_from_ray(self.rt_cam_ref, self.rt_ref_plane),
            self.rays,
            self.grid,
            flat=self.flat,
            valid=self.valid,
            lattice_of_view=self.lattice_of_view,
            dtype=np.float64,
            workers=self.workers,
        )


@st.composite
def cases(draw: st.DrawFn, max_rows: int = 19, max_columns: int = 71) -> Case:
    """Draw odd sizes, near and far planes, turned and displaced cameras that see some of the plane, mosaics, masks."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1), label="seed"))
    rows, columns = draw(st.tuples(st.integers(2, max_rows), st.integers(2, max_columns)), label="detector")
    views = draw(st.integers(1, 4), label="views")
    depth_mm = draw(st.sampled_from([120.0, 500.0, 20_000.0]), label="depth_mm")
    turn_rad = draw(st.sampled_from([0.0, 0.02, 0.4]), label="turn_rad")
    tilt_rad = draw(st.sampled_from([0.0, 0.5]), label="tilt_rad")
    mosaic = draw(st.booleans(), label="mosaic")
    # The pixel, on the mosaic's first phase, that looks at the plane's centre
    axis = (2 * (rows // 4), 2 * (columns // 4))
    lens = Lens((columns, rows), 90.0, 92.0, axis[1], axis[0], draw(st.sampled_from(DISTORTIONS)))
    rays = mosaic_rays(lens) if mosaic else lens.rays()[np.newaxis]
    shape = draw(st.tuples(st.integers(2, 11), st.integers(2, 45)), label="plane")
    pitch_mm = depth_mm / 90.0 * draw(st.sampled_from([0.6, 1.0, 2.3]), label="scale") * (2 if mosaic else 1)
    poses = generator.uniform(-1, 1, (views, 6)) * np.repeat([turn_rad, 4 * pitch_mm], 3)
    flat, masked = draw(st.booleans(), label="flat"), draw(st.booleans(), label="masked")
    lattice_of_view = generator.integers(0, len(rays), views)
    valid = generator.random((views, *rays.shape[1:3])) >= (0.1 if masked else 0.0)
    poses[0], lattice_of_view[0], valid[0] = 0, 0, True  # so that the first view certainly sees the plane
    return Case(
        rays,
        poses,
        np.array([*generator.uniform(-tilt_rad, tilt_rad, 3), 0, 0, depth_mm]),
        PlaneGrid(shape, pitch_mm, (-pitch_mm * (shape[1] - 1) / 2, -pitch_mm * (shape[0] - 1) / 2)),
        flat=generator.uniform(0.3, 1.0, rays.shape[:3]) if flat else np.ones(rays.shape[:3]),
        valid=valid,
        lattice_of_view=lattice_of_view,
        workers=draw(st.integers(1, 3), label="workers"),
    )


def mosaic_rays(lens: Lens) -> NDArray[np.float32]:
    """Return the rays (lattice, row, column, 2) of the four phases of a mosaic, cut to a common size."""
    rows, columns = lens.size_px[1] // 2, lens.size_px[0] // 2
    return np.stack([lens.rays(first, (2, 2))[:rows, :columns] for first in MOSAIC_PHASES])
