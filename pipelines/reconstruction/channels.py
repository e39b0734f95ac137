"""From the frames of an elemental set to what the solvers take: one set of elemental images per colour."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, plane_from_ray
from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.errors import BadValue, UnreadableImage, WrongBitDepth, WrongSize
from faintfield.pipelines.formats.frames import Frame, read_frame
from faintfield.pipelines.formats.large_arrays import Allocate
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane
from faintfield.pipelines.formats.sets.elemental_set import LoadedSet, noise_of_phase
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, binned
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.operator.scene_operator import SceneOperator

_COLOUR_NAMES = {"R": "red", "G": "green", "B": "blue"}
_RGB = ("red", "green", "blue")


@dataclass(frozen=True)
class Lattice:
    """The detector pixels of one phase of a mosaic; all of them without colour filters.

    Attributes
    ----------
    first, step : (int, int)
        Row and column of its first pixel, and the distance to its next.
    shape : (int, int)
        Rows and columns.
    """

    first: tuple[int, int]
    step: tuple[int, int]
    shape: tuple[int, int]

    def of(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return the lattice's part of an image (row, column)."""
        rows, columns = (slice(first, None, step) for first, step in zip(self.first, self.step, strict=True))
        return pixels[rows, columns][: self.shape[0], : self.shape[1]]


@dataclass(frozen=True)
class ChannelLayout:
    """Where in the frames one colour is found.

    Attributes
    ----------
    name : str
        "grey", "red", "green" or "blue".
    plane_of_colour : int, optional
        Index of the colour in RGB frames.
    lattices : tuple of Lattice
        One per phase of the mosaic that has this colour.
    """

    name: str
    plane_of_colour: int | None
    lattices: tuple[Lattice, ...]

    def of(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return the part of a frame (row, column[, colour]) that can hold this colour, (row, column)."""
        return pixels if self.plane_of_colour is None else pixels[:, :, self.plane_of_colour]


def channel_layouts(loaded: LoadedSet) -> list[ChannelLayout]:
    """Return the colours that a set's frames hold, judged by its first frame."""
    width, height = loaded.settings.camera.size_px
    frame = read_frame(loaded.image_paths[0])
    mosaic = loaded.settings.camera.mosaic or frame.mosaic
    everything = Lattice((0, 0), (1, 1), (height, width))
    if frame.pixels_dn.ndim == 3:
        return [ChannelLayout(name, index, (everything,)) for index, name in enumerate(_RGB)]
    if mosaic is None:
        return [ChannelLayout("grey", None, (everything,))]
    period = (len(mosaic), len(mosaic[0]))
    shape = (height // period[0], width // period[1])
    layouts = []
    for letter in sorted(set("".join(mosaic)), key="RGB".find):
        phases = [(r, c) for r, c in np.ndindex(*period) if mosaic[r][c] == letter]
        lattices = tuple(Lattice(phase, period, shape) for phase in phases)
        layouts.append(ChannelLayout(_COLOUR_NAMES.get(letter, letter), None, lattices))
    return layouts


def load_channel(loaded: LoadedSet, layout: ChannelLayout, allocate: Allocate = np.empty) -> ElementalImages:
    """Read one colour of all views into electrons; frames are read one at a time, straight into the stack.

    Parameters
    ----------
    loaded : LoadedSet
        The set.
    layout : ChannelLayout
        The colour.
    allocate : callable
        Makes the arrays of the size of all views: in memory by default.

    Raises
    ------
    WrongSize, WrongBitDepth, UnreadableImage
        A frame is not what the set says it is; the message names it.
    """
    phases = len(layout.lattices)
    views = len(loaded.settings.view)
    shape = layout.lattices[0].shape
    electrons = allocate((views * phases, *shape), np.float32)
    valid: NDArray[np.bool_] | None = None
    for view in range(views):
        for phase, (sum_e, over) in enumerate(view_electrons(loaded, layout, loaded.frame_paths(view))):
            electrons[view * phases + phase] = sum_e
            if over.any():
                if valid is None:
                    valid = allocate(electrons.shape, np.bool_)
                    valid.fill(True)
                valid[view * phases + phase] = ~over
    noises = [lattice_noise(loaded, lattice, None) for lattice in layout.lattices]
    return ElementalImages(
        electrons,
        background_e=_stacked([loaded.background_e(noise) for noise in noises], shape),
        read_variance_e2=_stacked([loaded.read_variance_e2(noise) for noise in noises], shape),
        valid=valid,
    )


def view_electrons(
    loaded: LoadedSet, layout: ChannelLayout, paths: Sequence[Path]
) -> list[tuple[NDArray[np.float32], NDArray[np.bool_]]]:
    """Return for each lattice the electrons (row, column) of all frames of a view, and where one of them is saturated.

    The sum says of the light all that the frames say one by one, up to the shape of the read noise: Poisson counts add
    up to Poisson counts, and variances add.
    """
    sums: list[tuple[NDArray[np.float32], NDArray[np.bool_]]] = []
    for path in paths:
        frame = checked_frame(loaded, path, layout)
        pixels = layout.of(frame.pixels_dn)
        for index, lattice in enumerate(layout.lattices):
            noise = lattice_noise(loaded, lattice, frame)
            pixels_dn = lattice.of(pixels)
            electrons, over = noise.electrons(pixels_dn), noise.saturated(pixels_dn)
            if path is paths[0]:
                sums.append((electrons, over))
            else:
                before_e, before_over = sums[index]
                sums[index] = (before_e + electrons, before_over | over)
    return sums


def checked_frame(loaded: LoadedSet, path: Path, layout: ChannelLayout) -> Frame:
    """Read a frame and refuse one that does not fit the set's camera and noise model."""
    frame = read_frame(path)
    width, height = loaded.settings.camera.size_px
    found = frame.pixels_dn
    if found.shape[:2] != (height, width):
        raise WrongSize(
            f"{path}: is {found.shape[1]} x {found.shape[0]} px, the camera {width} x {height} px; "
            "correct camera.size_px or take the view again"
        )
    if (found.ndim == 3) != (layout.plane_of_colour is not None):
        kind = "colour" if found.ndim == 3 else "grey"
        raise UnreadableImage(
            f"{path}: is {kind}, unlike the set's first view; all views must be of one kind; export all alike"
        )
    if found.dtype not in (np.uint8, np.uint16):
        raise WrongBitDepth(
            f"{path}: holds {found.dtype} pixels; elemental images are 8- or 16-bit whole numbers; export them so"
        )
    saturation_dn = loaded.noise.saturation_dn
    if found.dtype == np.uint8 and np.isfinite(saturation_dn) and saturation_dn > 255:
        raise WrongBitDepth(
            f"{path}: has 8 bits per pixel, but the noise model saturates at {saturation_dn:.0f} DN; "
            "export 16-bit images, or state the noise of the 8-bit ones (saturation_dn = 255)"
        )
    if loaded.offset_from_files and frame.black_dn is None:
        raise BadValue(f"{path}: brings no black level of its own; state noise.offset_dn in {loaded.folder}")
    return frame


def lattice_noise(loaded: LoadedSet, lattice: Lattice, frame: Frame | None) -> NoiseModel:
    """Return the noise model of a lattice; a raw frame brings its own black level and saturation if none is stated."""
    noise = noise_of_phase(loaded.noise, lattice.first, lattice.step, lattice.shape)
    if frame is None:
        return noise
    if loaded.offset_from_files and frame.black_dn is not None:
        black_dn = frame.black_dn[lattice.first] if frame.mosaic is not None else frame.black_dn.mean()
        noise = replace(noise, offset_dn=float(black_dn))
    if not np.isfinite(noise.saturation_dn) and frame.saturation_dn is not None:
        noise = replace(noise, saturation_dn=frame.saturation_dn)
    return noise


def require_in_front(depth_mm: float) -> None:
    """Refuse a plane that is not in front of the reference camera (GeometryMismatch)."""
    if not (np.isfinite(depth_mm) and depth_mm > 0):
        raise GeometryMismatch(f"a plane at {depth_mm} mm is not in front of the camera; depth_mm must be positive")


def default_pitch_px(loaded: LoadedSet, layouts: list[ChannelLayout]) -> int:
    """Return how many detector pixels apart a plane's samples are by default: one, where the views can fill that.

    A view sees only some pixels in each colour of a mosaic; with fewer views than it takes to fill the gaps, the
    samples are a period of the mosaic apart.
    """
    views = len(loaded.settings.view)
    step = layouts[0].lattices[0].step
    fewest_per_sample = min(views * len(layout.lattices) / (step[0] * step[1]) for layout in layouts)
    return 1 if fewest_per_sample >= 1 else max(step)


def plane_grid(loaded: LoadedSet, depth_mm: float, pitch_mm: float | None = None) -> PlaneGrid:
    """Return the samples of the plane at a depth: by default they overlay the reference view pixel for pixel.

    Raises
    ------
    GeometryMismatch
        The plane is not in front of the camera, or a pitch leaves it without samples.
    """
    require_in_front(depth_mm)
    camera = loaded.settings.camera
    cx_px, cy_px = loaded.principal_points_px()[loaded.reference_view].tolist()
    width, height = camera.size_px
    mm_per_px_x, mm_per_px_y = depth_mm / camera.fx_px, depth_mm / camera.fy_px
    try:
        return PlaneGrid.covering(
            left_mm=(-0.5 - cx_px) * mm_per_px_x,
            top_mm=(-0.5 - cy_px) * mm_per_px_y,
            right_mm=(width - 0.5 - cx_px) * mm_per_px_x,
            bottom_mm=(height - 0.5 - cy_px) * mm_per_px_y,
            pitch_mm=mm_per_px_x if pitch_mm is None else pitch_mm,
        )
    except ValueError as failure:
        raise GeometryMismatch(f"plane at {depth_mm:g} mm: {failure}") from failure


class OperatorFactory:
    """Makes the operators of one channel; what they share (rays, response, mask) is computed once.

    For images whose pixels were added up in bins (`ElementalImages.binned`) give as many `bins`.
    """

    def __init__(self, loaded: LoadedSet, layout: ChannelLayout, images: ElementalImages, *, bins: int = 1) -> None:
        self._loaded = loaded
        self._images = images
        self._phases = len(layout.lattices)
        lattices = layout.lattices
        rays = np.stack([_cropped_rays(loaded, lattice) for lattice in lattices])
        self._rays = np.moveaxis(binned(np.moveaxis(rays, -1, 0), bins), 0, -1)
        response = np.stack([_response(loaded, lattice) for lattice in lattices])
        whole = binned(response > 0, bins) == 1  # a bin with a pixel that never counts has its electrons, too
        self._response = np.where(whole, binned(response, bins), 0)
        self._principal_shift = _principal_shift(loaded)

    def at_depth(self, depth_mm: float, grid: PlaneGrid) -> PlaneOperator:
        """Return H of the plane across the reference camera's axis at a depth."""
        return self.at(depth_mm, grid)

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
            How much of each plane's light reaches each pixel; all by default.
        """
        homographies = np.stack([self._homographies(place) for place in grids])
        return SceneOperator(
            homographies, self._rays, list(grids.values()), transmission=transmission, **self._shared()
        )

    def _homographies(self, place: Place) -> NDArray[np.float64]:
        """Return the way from the rays of each view, and each phase of its mosaic, to a plane."""
        rt_ref_plane = (
            np.array(place.rt_ref_plane) if isinstance(place, TiltedPlane) else fronto_parallel_rt_ref_plane(place)
        )
        homographies = plane_from_ray(self._loaded.poses_rt_cam_ref, rt_ref_plane, self._principal_shift)
        return np.repeat(homographies, self._phases, axis=0)

    def _shared(self) -> dict[str, Any]:
        """Return what the operators of all planes have in common."""
        views = len(self._loaded.settings.view)
        lattices = np.tile(np.arange(self._phases), views)
        return {"flat": self._response, "valid": self._images.valid, "lattice_of_view": lattices}


def _stacked(parts: list[Any], shape: tuple[int, int]) -> Any:
    """Return one number when all lattices share it, else the maps (lattice, row, column)."""
    if all(np.ndim(part) == 0 and part == parts[0] for part in parts):
        return float(parts[0])
    return np.stack([np.broadcast_to(part, shape) for part in parts]).astype(np.float32)


def _cropped_rays(loaded: LoadedSet, lattice: Lattice) -> NDArray[np.float32]:
    """Return the rays of a lattice (row, column, 2); an incomplete period at the far edges is left out."""
    rays = loaded.lens.rays(lattice.first, lattice.step)
    return rays[: lattice.shape[0], : lattice.shape[1]].astype(np.float32)


def _response(loaded: LoadedSet, lattice: Lattice) -> NDArray[np.float32]:
    """Return the flat field of a lattice (row, column), zero at unusable pixels."""
    flat = np.ones(lattice.shape, np.float32) if loaded.flat is None else lattice.of(loaded.flat).copy()
    flat[lattice.of(loaded.unusable)] = 0
    return flat


def _principal_shift(loaded: LoadedSet) -> NDArray[np.float64] | None:
    """Return what is added to the rays of views whose principal point differs from the camera's."""
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
