"""The operator H of eq. (1): what each detector pixel of each view sees of a plane, and its exact adjoint."""

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.scene import SceneOperator, Views


class PlaneOperator:
    """H of one plane: matrix-free, linear, with the adjoint that shares its weights.

    Every view is taken by one camera, so the lens (distortion included) is one shared map from detector pixel to ray,
    and a view is one homography from rays to the plane. H interpolates the plane bilinearly at each detector pixel;
    Hᵀ spreads each pixel to the same four samples with the same weights. The images themselves are never resampled.
    A pixel sees the plane when all four samples around its point exist; otherwise its row of H is zero.

    Where `views` are asked for, all are meant by default. `recon.operator.scene.SceneOperator` does the same for several planes.

    Parameters
    ----------
    plane_from_ray : array (view, 3, 3)
        Homography from a ray (x, y, 1) to plane coordinates (x, y, 1) in mm; the homogeneous scale is positive for
        points in front of the camera.
    rays : array (row, column, 2) or (lattice, row, column, 2)
        Where each detector pixel looks: x, y at unit depth, lens distortion undone.
    grid : PlaneGrid
        The samples of the plane.
    flat : array (row, column) or (lattice, row, column), optional
        Relative response of each pixel (vignetting); zero for pixels that never count.
    valid : bool array (view, row, column), optional
        False for pixels that do not count in one view.
    lattice_of_view : int array (view,), optional
        Which lattice of detector pixels each view has; all the first by default.
    dtype : dtype
        Of planes and images: float32 for work, float64 for tests.
    workers : int, optional
        Threads; as many as the process may use by default. Sums depend on it in the last digits.

    Raises
    ------
    GeometryMismatch
        Shapes do not fit together, a number is not finite, or no pixel of any view sees the plane.

    Notes
    -----
    f is in expected electrons per detector pixel before flat field; see docs/physics.md, "The operator".
    """

    def __init__(
        self,
        plane_from_ray: NDArray[np.floating],
        rays: NDArray[np.floating],
        grid: PlaneGrid,
        *,
        flat: NDArray[np.floating] | None = None,
        valid: NDArray[np.bool_] | None = None,
        lattice_of_view: NDArray[np.intp] | None = None,
        dtype: type[np.float32] | type[np.float64] = np.float32,
        workers: int | None = None,
    ) -> None:
        self._scene = SceneOperator(
            plane_from_ray[np.newaxis],
            rays,
            [grid],
            flat=flat,
            valid=valid,
            lattice_of_view=lattice_of_view,
            dtype=dtype,
            workers=workers,
        )
        self.grid = grid
        self.dtype = self._scene.dtype
        self.images_shape = self._scene.images_shape
        self.all_views = self._scene.all_views
        self.maps_shape = self._scene.maps_shape
        self.lattice_of_view = self.all_views * 0 if lattice_of_view is None else lattice_of_view

    @property
    def seeing_views(self) -> NDArray[np.intp]:
        """The views of which some pixel that counts sees the plane."""
        return self._scene.seeing_views

    def forward(self, plane: Image, views: Views = None) -> Image:
        """Return H f: the plane (row, column) as each view sees it, (view, row, column)."""
        return self._scene.forward([plane], views)

    def adjoint(self, images: Image, views: Views = None) -> Image:
        """Return Hᵀ g (row, column) of images (view, row, column), summed over `views`."""
        return self._scene.adjoint(images, views)[0]

    def adjoint_of_map(self, value: float | Image, views: Views = None) -> Image:
        """Return Hᵀ applied to images that all equal one map, broadcastable to (lattice, row, column)."""
        return self._scene.adjoint_of_map(value, views)[0]

    def sensitivity(self, views: Views = None) -> Image:
        """Return s = Hᵀ 1 (row, column): without flat field, the number of views that see each sample."""
        return self.adjoint_of_map(1.0, views)

    def coverage(self, views: Views = None) -> Image:
        """Return Hᵀ H 1 (row, column), by which a back-projection is divided to keep a constant plane constant."""
        return self.adjoint_of_map(self._scene.response(), views)

    def value_and_ratio(self, plane: Image, images: ElementalImages, views: Views = None) -> tuple[float, Image]:
        """Return the negative log-likelihood of a plane and Hᵀ r (row, column), in one sweep.

        r is the ratio of `recon.likelihood.pixel_models`: the negative log-likelihood has the derivative s − Hᵀ r. Terms that do
        not depend on f are left out.
        """
        value, ratios = self._scene.value_and_ratio([plane], images, views)
        return value, ratios[0]

    def adjoint_of_ratio(self, plane: Image, images: ElementalImages, views: Views = None) -> Image:
        """Return Hᵀ r (row, column) alone: for shifted Poisson data Hᵀ[ (g + σ²)₊ / (H f + b + σ²) ], as in eq. (2)."""
        return self._scene.adjoint_of_ratio([plane], images, views)[0]

    def negative_log_likelihood(self, plane: Image, images: ElementalImages, views: Views = None) -> float:
        """Return the negative log-likelihood alone, in a sweep that only reads."""
        return self._scene.negative_log_likelihood([plane], images, views)


def compile_kernels() -> None:
    """Compile the kernels for float32, unless the cache beside the code has them.

    Done once per installation, it spares the first reconstruction some seconds and 60 MB.
    """
    PlaneOperator(np.eye(3)[np.newaxis], np.zeros((2, 2, 2)), PlaneGrid((2, 2), 1.0, (0.0, 0.0)))
