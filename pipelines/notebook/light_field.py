"""A light field: the views of a scene with their poses, lens and noise, and the planes reconstructed from them."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, Self, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintfield.calib.lens import Lens
from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.arguments import PriorName
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue, import_optional
from faintfield.pipelines.formats.files import exclusive, remove
from faintfield.pipelines.formats.frames import ChannelLayout
from faintfield.pipelines.formats.results.surface import SURFACE_FILE
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, light_per_e
from faintfield.pipelines.formats.units import Node, StatedUnits
from faintfield.pipelines.notebook import plotting
from faintfield.pipelines.notebook.array_set import set_of_arrays
from faintfield.pipelines.notebook.kept_plane import KeptPlane
from faintfield.pipelines.notebook.options import PlaneOptions, checked_options, naming_arguments, solver_options
from faintfield.pipelines.notebook.results import Array, Plane, Planes, Surface, surface_of_folder
from faintfield.pipelines.reconstruction.channels import keeping_frames, load_channel, view_electrons
from faintfield.pipelines.reconstruction.depth.autofocus import best_focus
from faintfield.pipelines.reconstruction.operators import OperatorFactory, requested_grid
from faintfield.pipelines.reconstruction.options import Options
from faintfield.pipelines.reconstruction.planes.sweep import run_serially
from faintfield.pipelines.reconstruction.request import Request, resolve, select_planes
from faintfield.pipelines.reconstruction.run import check_request, plan_sweep, warn_of
from faintfield.pipelines.reconstruction.surface.reconstruct import reconstruct_surface
from faintfield.pipelines.reconstruction.surface.request import SurfaceRequest
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.threads import map_in_threads

# More samples to a pixel make no sense: a mistake of units.
_MOST_SAMPLES_PER_PX = 4


@dataclass(frozen=True, eq=False)
class LightField:
    """The views of a scene, with the poses, lens and noise of their camera, from files or arrays.

    `faintfield.open` returns that of a set or session, `from_arrays` makes one of arrays.

    Parameters
    ----------
    elemental_set : ElementalSet
        Images, poses, lens and noise, checked.

    Examples
    --------
    >>> import faintfield, tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     options = faintfield.SyntheticOptions(rows=3, columns=3, size_px=(64, 48), snr=1.0)
    ...     _ = faintfield.simulate(Path(folder) / "set", options=options)
    ...     light_field = faintfield.open(Path(folder) / "set")
    ...     images_e = light_field.images_e
    >>> light_field
    <light field of 9 views of 64 x 48 px, grey, poses stated, depths in mm>
    >>> images_e.shape, light_field.poses.shape
    ((9, 48, 64), (9, 6))
    """

    elemental_set: ElementalSet

    @classmethod
    def from_arrays(
        cls,
        images: ArrayLike,
        poses: ArrayLike,
        lens: Lens,
        noise: NoiseModel,
        *,
        reference: int | None = None,
        nodes: Sequence[tuple[int, int]] | None = None,
        exposure_s: float | None = None,
        mosaic: Sequence[str] | None = None,
        flat: ArrayLike | None = None,
        unusable: ArrayLike | None = None,
    ) -> Self:
        """Return a light field of arrays, which are not copied.

        Parameters
        ----------
        images : array (view, row, column) or (view, row, column, RGB)
            The camera's values in DN, as the noise model counts; electrons with a gain of 1 and an offset of 0. Pixels
            that are NaN or saturated do not count.
        poses : array (view, 6)
            Rodrigues rad and mm, from a common frame to each camera; depths are along the axis of the reference view.
        lens : Lens
            Lens of all views.
        noise : NoiseModel
            Offset, gain, read noise and dark current.
        reference : int, optional
            Number of the reference view; by default the one whose pose is zero.
        nodes : sequence of (int, int), optional
            Row and column of each view in the grid.
        exposure_s : float, optional
            Exposure of each view, with which dark current counts.
        mosaic : sequence of str, optional
            Rows of the smallest period of colour filters, such as ("RG", "GB").
        flat : array (row, column), optional
            Relative response of each pixel.
        unusable : bool array (row, column), optional
            Pixels that are left out.

        Raises
        ------
        BadValue
            Shapes do not fit together, or a number is impossible; the message names it.
        """
        return cls(
            set_of_arrays(
                images, poses, lens, noise, reference=reference, nodes=nodes, exposure_s=exposure_s, mosaic=mosaic,
                flat=flat, unusable=unusable,
            )
        )  # fmt: skip

    def __repr__(self) -> str:
        width, height = self.lens.size_px
        return (
            f"<light field of {len(self.poses)} views of {width} x {height} px, {', '.join(self.channels)}, "
            f"poses {self.elemental_set.poses}, depths in {self.units.length or 'no unit'}>"
        )

    @property
    def poses(self) -> NDArray[np.float64]:
        """Poses rt_cam_ref (view, 6): Rodrigues rad and mm, from the reference camera to each camera."""
        return self.elemental_set.poses_rt_cam_ref

    @property
    def nodes(self) -> list[Node]:
        """Row and column of each view in the grid."""
        return self.elemental_set.nodes

    @property
    def reference(self) -> int:
        """Number of the reference view."""
        return self.elemental_set.reference_view

    @property
    def lens(self) -> Lens:
        """Lens of all views."""
        return self.elemental_set.lens

    @property
    def noise(self) -> NoiseModel:
        """Noise model of the camera."""
        return self.elemental_set.noise

    @property
    def units(self) -> StatedUnits:
        """Units of depth and light of all planes."""
        return self.elemental_set.units

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the colours, ("grey",) without any."""
        return tuple(layout.name for layout in self.elemental_set.layouts)

    @cached_property
    def images_e(self) -> Array:
        """All views in electrons (view, row, column[, colour]), those of a mosaic as its pixels; NaN where saturated.

        Read at the first use and kept; `data` has one colour as solvers take it.
        """
        layouts = self.elemental_set.layouts
        width, height = self.lens.size_px
        colours = () if layouts[0].plane_of_colour is None else (len(layouts),)
        images = np.empty((len(self.poses), height, width, *colours), np.float32)

        def load(view: int) -> None:
            images[view] = self.view_e(view)

        map_in_threads(load, range(len(images)))
        return images

    def view_e(self, view: int) -> Array:
        """Return one view in electrons (row, column[, colour]), as in `images_e`."""
        if not -len(self.poses) <= view < len(self.poses):
            raise BadValue(f"view: got {view}; give 0 to {len(self.poses) - 1}")
        elemental_set, layouts = self.elemental_set, self.elemental_set.layouts
        width, height = self.lens.size_px
        colours = () if layouts[0].plane_of_colour is None else (len(layouts),)
        image = np.full((height, width, *colours), np.nan, np.float32)
        for layout in layouts:
            parts = view_electrons(elemental_set, layout, elemental_set.frame_paths[view])
            for lattice, (electrons, over) in zip(layout.lattices, parts, strict=True):
                electrons[over] = np.nan
                lattice.of(layout.of(image))[:] = electrons
        return image

    def data(self, channel: str | None = None) -> ElementalImages:
        """Return one colour of all views in electrons, with background and read variance; the last one is kept."""
        layout = self._layout(channel)
        data = self._data.get(layout.name)
        if data is None:
            self._data.clear()
            data = self._data[layout.name] = load_channel(self.elemental_set, layout)
        return data

    def grid(self, depth: float, pitch: float | None = None) -> PlaneGrid:
        """Return the samples of a plane at a depth, one per pixel of the reference view by default.

        Its lengths are those of the poses, in mm where these are.
        """
        if pitch is not None and self.units.depth == "disparity_px":
            raise BadValue(f"pitch: got {pitch}, and the set knows disparities, no lengths; leave it out")
        return requested_grid(self.elemental_set, self._depth_mm(depth), pitch)

    def operator(
        self,
        depth: float,
        channel: str | None = None,
        pitch: float | None = None,
        dtype: type[np.float32] | type[np.float64] = np.float32,
    ) -> PlaneOperator:
        """Return H of a plane at a depth, for the pixels of `data`, with samples of a dtype."""
        factory = OperatorFactory(self.elemental_set, self._layout(channel), self.data(channel))
        return factory.at(self._depth_mm(depth), self.grid(depth, pitch), dtype=dtype)

    def find_depths(self, depth_range: tuple[float, float] | None = None) -> list[float]:
        """Return the depths of objects, found by comparing the views.

        Parameters
        ----------
        depth_range : (float, float), optional
            Nearest and farthest depth, in the unit of the set; by default all depths that the views share.

        Raises
        ------
        BadValue
            The range is none.
        NothingInFocus
            The views agree on nothing, or no better than shuffled ones.
        """
        ends = self._ends(depth_range)
        limits = ends and (self._depth_mm(ends[0]), self._depth_mm(ends[1]))
        with _scratch() as folder, naming_arguments():
            depths_mm = best_focus(self.elemental_set, folder, limits).depth_mm
        return [self.elemental_set.stated_depth(depth_mm) for depth_mm in depths_mm]

    def plane(self, depth: float, **options: Unpack[PlaneOptions]) -> Plane:
        """Reconstruct one plane; the options are those of `PlaneOptions`, and the failures those of `planes`."""
        if not isinstance(depth, Real):
            raise BadValue(f"depth: got {depth!r}; give one number, or several to `planes`")
        return self.planes([depth], **options)[0]

    def planes(
        self, depths: Sequence[float] | NDArray[Any] | Literal["auto"] = "auto", **options: Unpack[PlaneOptions]
    ) -> Planes:
        """Reconstruct planes at depths in the unit of the set, or at those of objects that are found.

        Parameters
        ----------
        depths : sequence of float or "auto"
            In mm, or what the set states depths in.
        **options
            Those of `PlaneOptions`.

        Raises
        ------
        BadValue
            Options are impossible, or contradict one another.
        ValueError
            A penalty or prior of one's own returned something else than samples.
        GeometryMismatch
            No two views see the same part of a plane.
        NothingInFocus
            No depth was found.
        NotConverged
            The penalty weight is too large.
        """
        options = checked_options(options)
        method, progress = options.get("method", "pmlem"), options.get("progress")
        with _scratch() as folder, naming_arguments():
            elemental_set = keeping_frames(self.elemental_set, folder)
            request = self._request(depths, options, folder)
            check_request(elemental_set, [], request)
            sweep = plan_sweep(elemental_set, {method: folder}, request, KeptPlane)
            tasks = sweep.tasks()
            for number, (_, messages) in enumerate(run_serially(elemental_set, folder, tasks), 1):
                for message in messages:
                    inform(message)
                if progress is not None:
                    progress(number, len(tasks))
        kept = sorted((files for files in sweep.plan.files if isinstance(files, KeptPlane)), key=KeptPlane.depth)
        planes = [files.plane(self.units) for files in kept]
        warn_of(elemental_set, [record for plane in planes for record in plane.records])
        return Planes(tuple(plane.records for plane in planes), self.units, planes.__getitem__)

    def surface(
        self,
        out: Path | str,
        depth_range: tuple[float, float] | None = None,
        *,
        prior: PriorName | None = None,
    ) -> Surface:
        """Reconstruct one picture that is sharp everywhere, with the depth of each sample, into a folder of files.

        Parameters
        ----------
        out : path
            Folder of the result. A surface of the same files and options that it holds is kept.
        depth_range : (float, float), optional
            Nearest and farthest depth, in the unit of the set; by default found by comparing the views.
        prior : str, optional
            "tv", "patches", "learned" or "auto"; by default total variation, with detail added by a filter of patches.

        Raises
        ------
        BadValue
            There are too few or too small views, or the range is none.
        NothingInFocus
            The views tell no depths, or agree no better than shuffled ones.
        OutputExists, OutputBusy
            The folder holds a depth map, or another command is writing into it.
        """
        folder, ends = Path(out), self._ends(depth_range)
        in_px = self.units.depth == "disparity_px"
        solver = solver_options(PlaneOptions() if prior is None else PlaneOptions(prior=prior))
        with exclusive(folder), naming_arguments():
            if self.elemental_set.in_memory:
                remove(folder / SURFACE_FILE)  # nothing tells whether it was made of the same arrays
            request = SurfaceRequest(ends, "px" if in_px and ends else "mm", solver)
            reconstruct_surface(keeping_frames(self.elemental_set, folder), folder, request)
            return surface_of_folder(folder)

    def plot(self, view: int | None = None, axes: Any = None) -> Any:
        """Draw one view in electrons, by default the reference view, and return the matplotlib axes."""
        view = self.reference if view is None else view
        light = self.view_e(view) * np.float32(light_per_e(self.elemental_set))
        return plotting.draw_light(axes, light, self.units, title=f"view {view}")

    def to_xarray(self) -> Any:
        """Return `images_e`, poses and nodes as an `xarray.Dataset`; MissingPackage without xarray."""
        xarray = import_optional("xarray", "notebook")
        names = ("view", "row", "column", "colour")[: self.images_e.ndim]
        rows, columns = np.array(self.nodes).T
        arrays = {
            "images": (names, self.images_e, {"units": "electrons"}),
            "poses": (("view", "rt_cam_ref"), self.poses, {"units": "rad, mm"}),
        }
        return xarray.Dataset(arrays, {"node_row": ("view", rows), "node_column": ("view", columns)})

    def _request(
        self, depths: Sequence[float] | NDArray[Any] | Literal["auto"], options: PlaneOptions, folder: Path
    ) -> Request:
        """Return the planes to make, with options as commands take them; `folder` is for temporary files."""
        if isinstance(depths, str) and depths != "auto":
            raise BadValue(f"depths: got {depths!r}; give numbers, or 'auto'")
        asked: list[float | Literal["auto"]] = ["auto"]
        if not isinstance(depths, str):
            asked = [*np.atleast_1d(np.asarray(depths, float)).tolist()]
        if not asked:
            raise BadValue("depths: none is given; give some, or 'auto'")
        method = options.get("method", "pmlem")
        selection = select_planes(
            Options(depth=asked, method=[method], solver=solver_options(options), pitch_mm=options.get("pitch"))
        )
        request = resolve(selection, self.elemental_set, folder)
        self._check_depths(request.depths_mm, request.pitch_mm)
        return request

    def _check_depths(self, depths_mm: Sequence[float], pitch_mm: float | None) -> None:
        """Refuse a pitch of many samples per pixel; say if points hardly move: lengths may be in another unit."""
        per_px = min(depths_mm) / self.lens.fx_px / pitch_mm if pitch_mm else 0.0
        if per_px > _MOST_SAMPLES_PER_PX:
            raise BadValue(
                f"pitch: got {pitch_mm:g}, {per_px:.3g} samples to a pixel; at most {_MOST_SAMPLES_PER_PX} make sense: "
                "give a larger one"
            )
        moved_mm = float(np.linalg.norm(self.poses[:, 3:5], axis=1).max())
        moved_px = self.lens.fx_px * moved_mm / max(depths_mm)
        if len(self.poses) > 1 and moved_px < 1:
            inform(
                f"poses: points at {self.elemental_set.depth_text(max(depths_mm))} move by {moved_px:.2g} px in all "
                "views together; poses and depths are in mm, check both"
            )

    @cached_property
    def _data(self) -> dict[str, ElementalImages]:
        return {}

    def _layout(self, channel: str | None) -> ChannelLayout:
        layouts = {layout.name: layout for layout in self.elemental_set.layouts}
        if channel is None and len(layouts) == 1:
            return next(iter(layouts.values()))
        if channel not in layouts:
            raise BadValue(f"channel {channel!r}: the views have {', '.join(layouts)}; name one of these")
        return layouts[channel]

    def _ends(self, depth_range: tuple[float, float] | None) -> tuple[float, float] | None:
        """Return the smaller and the larger end of a range of depths; BadValue if it is none."""
        if depth_range is None:
            return None
        try:
            least, most = sorted(map(float, depth_range))
        except (TypeError, ValueError) as failure:
            message = f"depth_range: got {depth_range!r}; give two numbers, (nearest, farthest)"
            raise BadValue(message) from failure
        possible = least > 0 or self.units.depth == "disparity_px"
        if not possible or least == most or not np.isfinite([least, most]).all():
            raise BadValue(f"depth_range: got {depth_range}; give two different depths in front of the camera")
        return least, most

    def _depth_mm(self, depth: float) -> float:
        return self.elemental_set.depth_in_mm(depth)


def reconstruct(
    images: ArrayLike,
    poses: ArrayLike,
    lens: Lens,
    noise: NoiseModel,
    depths: Sequence[float] | NDArray[Any] | Literal["auto"] = "auto",
    *,
    reference: int | None = None,
    exposure_s: float | None = None,
    **options: Unpack[PlaneOptions],
) -> Planes:
    """Reconstruct planes from arrays, without files.

    Parameters
    ----------
    images, poses, lens, noise, reference, exposure_s
        As for `LightField.from_arrays`, which takes mosaics, flat fields and bad pixels, too.
    depths : sequence of float or "auto"
        Depths in mm along the axis of the reference view, or "auto" for those of objects that are found.
    **options
        Those of `PlaneOptions`: prior, penalty, uncertainty, progress and others.

    Returns
    -------
    Planes
        A sequence of planes, with their light in electrons per pixel.

    Raises
    ------
    BadValue
        Shapes do not fit together, or a number is impossible; see also `LightField.planes`.

    Examples
    --------
    Four views of an even scene at 400 mm, of 2 electrons per pixel and a read noise of 3 electrons:

    >>> import numpy as np
    >>> from faintfield import Lens, NoiseModel, reconstruct
    >>> lens = Lens(size_px=(32, 24), fx_px=40.0, fy_px=40.0, cx_px=15.5, cy_px=11.5)
    >>> poses = np.zeros((4, 6))
    >>> poses[:, 3] = [0.0, -10.0, -20.0, -30.0]  # a camera moved to the right maps points to the left
    >>> rng = np.random.default_rng(1)
    >>> images = rng.poisson(2.0, (4, 24, 32)) + rng.normal(0.0, 3.0, (4, 24, 32))
    >>> noise = NoiseModel(offset_dn=0.0, gain_dn_per_e=1.0, read_noise_e=3.0)
    >>> (plane,) = reconstruct(images, poses, lens, noise, [400.0], prior="tv", penalty_weight=2.0)
    >>> plane.image.shape, bool(abs(plane.image.mean() - 2.0) < 0.3)
    ((24, 32), True)
    """
    light_field = LightField.from_arrays(images, poses, lens, noise, reference=reference, exposure_s=exposure_s)
    return light_field.planes(depths, **options)


@contextmanager
def _scratch() -> Iterator[Path]:
    """Make a folder for frames and electrons that do not fit into memory, and remove it."""
    with TemporaryDirectory(prefix="faintfield-") as folder:
        yield Path(folder)
