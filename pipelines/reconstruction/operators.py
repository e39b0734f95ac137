"""The operator H of a plane, or of several, from the poses, the lens and the response of an elemental set."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, plane_from_ray
from faintfield.pipelines.formats.mosaic import Lattice
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import ChannelLayout
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, binned
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.operator.scene_operator import SceneOperator


class OperatorFactory:
    """Makes the operators of one channel; rays, response and mask, which they share, are computed once.

    `bins` is the width of the bins of images from `ElementalImages.binned`.
    """

    def __init__(self, loaded: ElementalSet, layout: ChannelLayout, images: ElementalImages, *, bins: int = 1) -> None:
        self._loaded = loaded
        self._images = images
        self._phases = len(layout.lattices)
        lattices = layout.lattices
        rays = np.stack([_cropped_rays(loaded, lattice) for lattice in lattices])
        self._rays = np.moveaxis(binned(np.moveaxis(rays, -1, 0), bins), 0, -1)
        response = np.stack([_response(loaded, lattice) for lattice in lattices])
        whole = binned(response > 0, bins) == 1  # a bin with an unusable pixel holds the electrons of that, too
        self._response = np.where(whole, binned(response, bins), 0)
        self._principal_shift = _principal_shift(loaded)

    def at(self, place: Place, grid: PlaneGrid) -> PlaneOperator:
        """Return H of a plane at a depth, or of a pose."""
        return PlaneOperator(self._homographies(place), self._rays, grid, **self._shared())

    def of_scene(
        self, grids: Mapping[Place, PlaneGrid], transmission: NDArray[np.float32] | None = None
    ) -> SceneOperator:
        """Return H of all planes together, in the order of `grids`.

        Parameters
        ----------
        grids : mapping of Place to PlaneGrid
            The samples of each plane.
        transmission : float array (plane, view, row, column), optional
            Share of each plane's light that reaches each pixel; 1 by default.
        """
        homographies = np.stack([self._homographies(place) for place in grids])
        return SceneOperator(
            homographies, self._rays, list(grids.values()), transmission=transmission, **self._shared()
        )

    def _homographies(self, place: Place) -> NDArray[np.float64]:
        """Return the homographies from the rays of each view, and each phase of its mosaic, to a plane."""
        rt_ref_plane = (
            np.array(place.rt_ref_plane) if isinstance(place, TiltedPlane) else fronto_parallel_rt_ref_plane(place)
        )
        homographies = plane_from_ray(self._loaded.poses_rt_cam_ref, rt_ref_plane, self._principal_shift)
        return np.repeat(homographies, self._phases, axis=0)

    def _shared(self) -> dict[str, Any]:
        """Return the arguments that the operators of all planes share."""
        views = len(self._loaded.settings.view)
        lattices = np.tile(np.arange(self._phases), views)
        return {"flat": self._response, "valid": self._images.valid, "lattice_of_view": lattices}


def _cropped_rays(loaded: ElementalSet, lattice: Lattice) -> NDArray[np.float32]:
    """Return the rays of a lattice (row, column, 2); an incomplete period at the far edges is left out."""
    rays = loaded.lens.rays(lattice.first, lattice.step)
    return rays[: lattice.shape[0], : lattice.shape[1]].astype(np.float32)


def _response(loaded: ElementalSet, lattice: Lattice) -> NDArray[np.float32]:
    """Return the flat field of a lattice (row, column), zero at unusable pixels."""
    flat = np.ones(lattice.shape, np.float32) if loaded.flat is None else lattice.of(loaded.flat).copy()
    flat[lattice.of(loaded.unusable)] = 0
    return flat


def _principal_shift(loaded: ElementalSet) -> NDArray[np.float64] | None:
    """Return the shift (view, 2) of the rays of views with a principal point of their own, None without such views."""
    camera = loaded.settings.camera
    shift_px = np.array([camera.cx_px, camera.cy_px]) - loaded.principal_points_px()
    if not shift_px.any():
        return None
    if any(camera.distortion):
        view = int(np.flatnonzero(shift_px.any(axis=1))[0])
        raise GeometryMismatch(
            f"view[{view}] has a principal point of its own while the camera has distortion {list(camera.distortion)}; "
            "a sheared or rectified light field has none: remove one of the two"
        )
    return np.asarray(shift_px / [camera.fx_px, camera.fy_px])
