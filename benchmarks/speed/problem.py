"""The benchmark problem: the paper's grid, a distorted lens, maps of every pixel property, dark data."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, plane_from_ray
from faintfield.calib.lens import Lens
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import Occluders
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.rig.plan import nominal_poses_rt_cam_ref

DEPTH_MM = 500.0


@dataclass(frozen=True)
class BenchmarkProblem:
    """Views of a square detector: each pixel has its own response, background and noise, and some are bad."""

    lens: Lens
    poses: NDArray[np.float64]
    flat: NDArray[np.float32]
    images: ElementalImages

    @classmethod
    def of_size(cls, size_px: int, views: int = 49) -> "BenchmarkProblem":
        """Return the problem for a lens of 8 % distortion and poses that are off by 0.2° and 0.3 mm."""
        generator = np.random.default_rng(1)
        poses = nominal_poses_rt_cam_ref(7, 7, 50.0) + generator.normal(size=(49, 6)) * np.repeat([0.0035, 0.3], 3)
        f_px, shape = 1.25 * size_px, (views, size_px, size_px)
        lens = Lens((size_px, size_px), f_px, f_px, size_px / 2, size_px / 2, (-0.08, 0.02))
        electrons = np.empty(shape, np.float32)
        valid = np.empty(shape, bool)
        for view in range(views):
            electrons[view] = generator.normal(1.0, 3.6, shape[1:])
            valid[view] = generator.random(shape[1:], np.float32) > 1e-3
        maps = generator.uniform([[[0.5]], [[0.0]], [[10.0]]], [[[1.0]], [[0.05]], [[14.0]]], (3, *shape[1:]))
        flat, background, variance = maps.astype(np.float32)
        return cls(lens, poses[:views], flat, ElementalImages(electrons, background, variance, valid))

    def homographies(self, depth_mm: float = DEPTH_MM) -> NDArray[np.float64]:
        """Return the homographies (view, 3, 3) from rays to the plane at a depth."""
        return plane_from_ray(self.poses, fronto_parallel_rt_ref_plane(depth_mm))

    def grid(self, depth_mm: float = DEPTH_MM) -> PlaneGrid:
        """Return the samples that overlay the reference view's pixels."""
        size_px, pitch_mm = self.lens.size_px[0], depth_mm / self.lens.fx_px
        return PlaneGrid((size_px, size_px), pitch_mm, (-size_px / 2 * pitch_mm, -size_px / 2 * pitch_mm))

    def scene(self, depths_mm: Sequence[float], opacities: Sequence[Image] | None = None) -> SceneOperator:
        """Return H of several planes, which hide one another if opacities (row, column) are given."""
        return SceneOperator(
            np.stack([self.homographies(depth) for depth in depths_mm]),
            self.lens.rays(),
            [self.grid(depth) for depth in depths_mm],
            flat=self.flat,
            valid=self.images.valid,
            occluders=None if opacities is None else Occluders(opacities, depths_mm),
        )

    def operator(self, workers: int | None = None) -> PlaneOperator:
        """Return H."""
        return PlaneOperator(
            self.homographies(),
            self.lens.rays(),
            self.grid(),
            flat=self.flat,
            valid=self.images.valid,
            workers=workers,
        )
