"""Sessions, sets, results and arrays as objects in Python: the same planes as the commands make, from files or not."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import faintfield
from faintfield import InputError, LightField, Plane, PlaneOptions, Planes, SyntheticOptions
from faintfield.calib.homography import rotation_matrix
from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.commands.reconstruction import reconstruct as reconstruct_command
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.notebook.options import naming_arguments
from faintfield.pipelines.reconstruction.options import Options
from faintfield.recon.errors import NothingInFocus
from faintfield.recon.likelihood.images import Image
from tests.pipelines.surfaces import FOUND_MM, Searches

DEPTHS = [800.0, 1250.0]


def open_set(folder: Path) -> LightField:
    light_field = faintfield.open(folder)
    assert isinstance(light_field, LightField)
    return light_field


def simulated(colour: Literal["grey", "bayer"], factory: pytest.TempPathFactory) -> Path:
    out = factory.mktemp(colour) / "set"
    options = SyntheticOptions(rows=3, columns=3, size_px=(72, 54), snr=1.0, colour=colour)
    faintfield.simulate(out, options=options)
    return out


@pytest.fixture(scope="module")
def grey_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated("grey", tmp_path_factory)


@pytest.fixture(scope="module")
def bayer_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated("bayer", tmp_path_factory)


@pytest.fixture(params=["grey", "bayer"])
def folder(request: pytest.FixtureRequest) -> Path:
    return Path(request.getfixturevalue(f"{request.param}_folder"))


def frames_of(folder: Path) -> Image:
    return np.stack([read_frame(path).pixels_dn for path in load_set(folder).image_paths])


def test_planes_are_those_of_command_whether_just_made_or_read(folder: Path, tmp_path: Path) -> None:
    steps = list[tuple[int, int]]()
    solver, of_planes = SolverOptions(prior="patches", uncertainty=True), PlaneOptions(prior="patches")
    if folder.parent.name.startswith("bayer"):  # three colours would take three times as long
        solver = SolverOptions(prior="tv", penalty_weight=2.0, passes=3)
        of_planes = PlaneOptions(prior="tv", penalty_weight=2.0, passes=3)
    of_planes |= PlaneOptions(uncertainty=solver.uncertainty, progress=lambda done, count: steps.append((done, count)))
    made = open_set(folder).planes(DEPTHS, **of_planes)
    options = Options(depth=[*DEPTHS], solver=solver)
    reconstruct_command(folder, out=tmp_path / "planes", options=options)
    read = faintfield.open(tmp_path / "planes")
    assert isinstance(read, Planes)
    assert steps[-1] == (len(steps), len(steps))
    assert made.depths == read.depths == tuple(DEPTHS)
    assert np.array_equal(made.images, read.images)
    for plane, stored in zip(made, read, strict=True):
        assert (plane.sigma is not None) == (stored.sigma is not None) == solver.uncertainty
        if plane.sigma is not None and stored.sigma is not None:
            assert np.array_equal(plane.sigma, stored.sigma)
        weights, stored_weights = ([record.penalty_weight for record in each.records] for each in (plane, stored))
        assert weights == stored_weights
        assert plane.channels == stored.channels
    assert read.result is not None
    assert read.result.inputs


def test_arrays_have_planes_of_files_in_any_frame(folder: Path) -> None:
    stored = open_set(folder)
    # The same cameras in the frame of another: x' = R x + t
    rt = np.array([0.1, -0.2, 0.3, 40.0, -30.0, 20.0])
    moved = np.array(
        [
            [*rodrigues(rotation_matrix(pose) @ rotation_matrix(rt)), *rotation_matrix(pose) @ rt[3:] + pose[3:]]
            for pose in stored.poses
        ]
    )
    light_field = LightField.from_arrays(
        frames_of(folder), moved, stored.lens, stored.noise, reference=stored.reference, nodes=stored.nodes,
        exposure_s=stored.elemental_set.settings.exposure_s, mosaic=stored.elemental_set.settings.camera.mosaic,
        flat=stored.elemental_set.flat,
    )  # fmt: skip
    assert np.allclose(light_field.poses, stored.poses, atol=1e-9)
    expected, found = (each.plane(800.0, prior="tv").image for each in (stored, light_field))
    assert np.allclose(found, expected, atol=1e-3 * expected.max())


def rodrigues(matrix: Image) -> Image:
    return np.asarray(Rotation.from_matrix(matrix).as_rotvec())


def test_electrons_are_pixels_without_offset_and_gain(folder: Path) -> None:
    light_field = open_set(folder)
    frames, noise = frames_of(folder), light_field.noise
    assert np.allclose(light_field.images_e, (frames - noise.offset_dn) / noise.gain_dn_per_e, atol=1e-3)
    channel = light_field.channels[0]
    operator, data = light_field.operator(800.0, channel), light_field.data(channel)
    assert operator.images_shape == data.electrons.shape
    assert operator.grid == light_field.grid(800.0)


def test_pixels_that_are_nan_do_not_count(grey_folder: Path) -> None:
    light_field = open_set(grey_folder)
    images = frames_of(grey_folder).astype(float)
    arguments = (light_field.poses, light_field.lens, light_field.noise)
    exposure_s = light_field.elemental_set.settings.exposure_s
    mosaic = light_field.elemental_set.settings.camera.mosaic
    images[2, 10:20, 10:20] = light_field.noise.saturation_dn - 1
    spoiled, without = images.copy(), images.copy()
    without[2, 10:20, 10:20] = np.nan
    spoiled_plane, plane = (
        LightField.from_arrays(each, *arguments, exposure_s=exposure_s, mosaic=mosaic).plane(800.0, prior="tv").image
        for each in (spoiled, without)
    )
    assert plane.max() < 0.1 * spoiled_plane.max()


class Blur:
    """A denoiser that is good where light is smooth."""

    def __call__(self, picture: Image, sigma: Image) -> Image:
        assert picture.shape == sigma.shape
        assert (sigma > 0).all()
        return np.asarray(gaussian_filter(picture, 3.0))


def nonsense(picture: Image, sigma: Image) -> Image:
    return np.random.default_rng(1).normal(0, 100, picture.shape)


def smooth_light_field(light_e: float = 1.0, blur: float = 5.0, step_px: int = 4) -> tuple[LightField, Image]:
    """Return 25 views of a smooth plane at 400 mm, each some whole pixels further, and its light in the middle one."""
    rng = np.random.default_rng(1)
    wide = gaussian_filter(rng.normal(0, 1, (80, 90)), blur)
    light = light_e * (1.0 + wide / np.abs(wide).max())
    lens = faintfield.Lens(size_px=(64, 48), fx_px=80.0, fy_px=80.0, cx_px=31.5, cy_px=23.5)
    steps = [(row, column) for row in range(-2, 3) for column in range(-2, 3)]
    # A camera that moves 5 mm to the right sees points move 80 · 5/400 = 1 px to the left
    pitch_mm = 5.0 * step_px
    views = [light[16 + step_px * row :, 13 + step_px * column :][:48, :64] for row, column in steps]
    poses = [(0.0, 0.0, 0.0, -pitch_mm * column, -pitch_mm * row, 0.0) for row, column in steps]
    images = rng.poisson(views) + rng.normal(0, 3.0, (25, 48, 64))
    noise = faintfield.NoiseModel(offset_dn=0.0, gain_dn_per_e=1.0, read_noise_e=3.0)
    return LightField.from_arrays(images, poses, lens, noise), light[16:, 13:][:48, :64]


def test_denoiser_counts_as_far_as_it_predicts_held_out_views() -> None:
    light_field, truth = smooth_light_field()
    alone = light_field.plane(400.0, prior="tv").image
    blurred = light_field.plane(400.0, prior=Blur())
    of_nonsense = light_field.plane(400.0, prior=nonsense).image

    def error(image: Image) -> float:
        return float(np.mean((image - truth)[8:-8, 8:-8] ** 2))

    (record,) = blurred.records
    assert record.prior
    assert record.prior.name == "Blur"
    assert error(blurred.image) < 0.7 * error(alone)
    assert error(of_nonsense) < 1.05 * error(alone)
    assert blurred.units.light == "electrons"


def test_denoiser_of_wrong_shape_is_refused(grey_folder: Path) -> None:
    with pytest.raises(ValueError, match="must return one of shape"):
        open_set(grey_folder).plane(1000.0, prior=lambda picture, sigma: picture[1:])


def test_contradictions_are_refused(grey_folder: Path) -> None:
    light_field = open_set(grey_folder)
    combinations: list[PlaneOptions] = [
        {"penalty": Tikhonov(), "prior": "auto"},
        {"penalty": Tikhonov(), "prior": Blur()},
        {"penalty": Tikhonov(), "uncertainty": True},
    ]
    for options in combinations:
        with pytest.raises(BadValue, match="leave"):
            light_field.plane(1000.0, **options)
    wrong: list[tuple[dict[str, object], str]] = [
        ({"prior": "atuo"}, "got 'atuo'; give one of tv, patches"),
        ({"prior": 5}, "an? int cannot be called"),
        ({"penalty": 5}, "no `value` and `prox`"),
        ({"penalty": Tikhonov}, "got the class Tikhonov"),
        ({"penalty": Tikhonov(), "method": "mlem"}, "one of your own is for joint, occlusion, pmlem, got mlem"),
        ({"method": "mlem", "uncertainty": True}, "uncertainty is for pmlem"),
        ({"passes": 1.5}, "give a whole number"),
        ({"pitch": 0.0}, "pitch: got 0"),
        ({"pitch": 1e-3}, "samples to a pixel"),
        ({"penalty_weight": -1.0}, "penalty_weight: got -1"),
    ]
    plane: Callable[..., Plane] = light_field.plane
    planes: Callable[..., Planes] = light_field.planes
    for values, message in wrong:
        with pytest.raises(BadValue, match=message):
            plane(1000.0, **values)
    with pytest.raises(TypeError, match="weight: is no option of planes"):
        plane(1000.0, weight=1.0)
    with pytest.raises(BadValue, match="got 'atuo'; give numbers, or 'auto'"):
        planes("atuo")
    with pytest.raises(BadValue, match="channel 'infrared'"):
        light_field.operator(800.0, "infrared")
    ranges: list[tuple[Any, str]] = [(500.0, "two numbers"), ((-5.0, 500.0), "two different depths in front")]
    for depth_range, message in ranges:
        with pytest.raises(BadValue, match=f"depth_range: got .*; give {message}"):
            light_field.find_depths(depth_range)


class Tikhonov:
    def value(self, plane: Image) -> float:
        return 0.5 * float(np.vdot(plane, plane))

    def prox(self, point: Image, metric: Image, weight: float) -> Image:
        return np.asarray(np.maximum(metric * point / (metric + weight), 0))


def test_penalty_of_ones_own_has_weight_by_held_out_views(folder: Path) -> None:
    plane = open_set(folder).plane(1000.0, penalty=Tikhonov())
    for record in plane.records:
        assert record.penalty
        assert record.penalty.name == "Tikhonov"
        assert record.penalty_weight_chosen.startswith("predicts held-out views")
        assert record.certificate
        assert not record.certificate.is_bound


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": np.zeros((2, 5, 6))}, "for a lens of 8 x 6 px"),
        ({"images": np.zeros((2, 6, 8), complex)}, "got complex128"),
        ({"poses": np.zeros((3, 6))}, r"2 views need an array of shape \(2, 6\), got \(3, 6\)"),
        ({"poses": [[0] * 6, [np.nan] * 6]}, "that of view 1 is"),
        ({"lens": None}, "lens: got a NoneType; give a faintfield.Lens"),
        ({"nodes": [(0, 0)]}, "got 1 for 2 views"),
        ({"nodes": [(0, 0), (0, 0)]}, "named by more than one view"),
        ({"reference": 2}, "got 2 for 2 views"),
        ({"exposure_s": -1.0}, "exposure_s = -1"),
        ({"noise": faintfield.NoiseModel(np.zeros((2, 2)), 1.0, 3.0)}, "offset_dn has shape"),
        ({"poses": np.ones((2, 6))}, "none is zero"),
        ({"mosaic": ("RG", "XB")}, "letters R, G and B"),
        ({"flat": -np.ones((6, 8))}, "flat: "),
        ({"noise": faintfield.NoiseModel(0.0, 1.0, 3.0, dark_current_e_per_s=1.0)}, "give exposure_s"),
    ],
)
def test_arrays_that_do_not_fit_are_named(change: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {
        "images": np.zeros((2, 6, 8)),
        "poses": np.zeros((2, 6)),
        "lens": faintfield.Lens((8, 6), 8.0, 8.0, 3.5, 2.5),
        "noise": faintfield.NoiseModel(0.0, 1.0, 3.0),
    }
    from_arrays: Callable[..., LightField] = LightField.from_arrays
    with pytest.raises(BadValue, match=message):
        from_arrays(**(arguments | change))


def test_folders_that_cannot_be_opened_are_explained(tmp_path: Path, grey_folder: Path) -> None:
    with pytest.raises(InputError, match="no such folder; name a session, a set or a folder of results"):
        faintfield.open(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"elemental\.toml"):
        faintfield.open(tmp_path)


def test_xarray_and_plots_have_places_and_units(grey_folder: Path) -> None:
    light_field = open_set(grey_folder)
    planes = light_field.planes(DEPTHS, method="backprojection")
    array = planes.to_xarray().light
    pitch_mm = 800.0 / light_field.lens.fx_px
    assert float(array.x[0, 1] - array.x[0, 0]) == pytest.approx(pitch_mm)
    assert array.depth.attrs["units"] == "mm"
    plane = planes[0]
    assert plane.to_xarray().light.shape == plane.image.shape
    axes = plane.plot()
    left, right, bottom, top = axes.get_images()[0].get_extent()
    assert (left, top) == pytest.approx((plane.x[0] - pitch_mm / 2, plane.y[0] - pitch_mm / 2))
    assert (right, bottom) == pytest.approx((plane.x[-1] + pitch_mm / 2, plane.y[-1] + pitch_mm / 2))
    assert axes.get_xlabel() == "x, mm"
    assert len(planes.plot().axes) == 2
    assert light_field.to_xarray().images.shape == light_field.images_e.shape
    light_field.plot()


def test_depths_of_objects_are_found() -> None:
    light_field, _ = smooth_light_field(light_e=30.0, blur=1.5)
    assert light_field.find_depths((300.0, 600.0)) == pytest.approx([400.0], rel=0.03)


def test_failures_name_arguments(grey_folder: Path) -> None:
    light_field = open_set(grey_folder)
    dark = LightField.from_arrays(
        np.zeros((9, 54, 72)), light_field.poses, light_field.lens, faintfield.NoiseModel(0.0, 1.0, 3.0)
    )
    with pytest.raises(NothingInFocus, match=r"make planes at known depths \(depths\)$"):
        dark.find_depths((700.0, 1500.0))
    with pytest.raises(NothingInFocus, match=r"^/a--depth: give depths, passes or --flip-rows$"), naming_arguments():
        raise NothingInFocus("/a--depth: give --depth, --passes or --flip-rows")


def test_grid_is_that_of_plane(folder: Path) -> None:
    light_field = open_set(folder)
    for pitch in (None, 11.0):
        options = PlaneOptions(method="backprojection") | (PlaneOptions(pitch=pitch) if pitch else PlaneOptions())
        (record, *_), grid = light_field.plane(800.0, **options).records, light_field.grid(800.0, pitch)
        assert (record.shape, record.pitch_mm, record.origin_mm) == (grid.shape, grid.pitch_mm, grid.origin_mm)


@pytest.mark.deep
def test_depths_of_surface_are_right(tmp_path: Path) -> None:
    light_field, _ = smooth_light_field(light_e=30.0, blur=1.5, step_px=6)
    surface = light_field.surface(tmp_path, (300.0, 600.0))
    assert np.median(surface.depth[surface.sure]) == pytest.approx(400.0, rel=0.03)
    assert surface.sure.any()


def test_surface_is_reconstructed_and_opened(tmp_path: Path, seen: Searches) -> None:
    light_field, _ = smooth_light_field(light_e=30.0, blur=1.5)
    surface = light_field.surface(tmp_path / "surface", (300.0, 600.0))
    ((views, inverse_depths),) = seen
    assert len(views.light_e) == 25
    assert 1 / np.array([inverse_depths.max(), inverse_depths.min()]) == pytest.approx([300.0, 600.0], rel=0.01)
    assert np.median(surface.depth) == pytest.approx(FOUND_MM)
    assert not surface.sure.any()
    assert len(surface.plot().axes) == 3
    opened = faintfield.open(tmp_path)
    assert isinstance(opened, faintfield.Surface)
    assert np.array_equal(opened.picture, surface.picture)
    with pytest.raises(BadValue, match="two different depths"):
        light_field.surface(tmp_path / "other", (400.0, 400.0))
    # Other arrays have another surface, also in the folder of the first
    brighter, _ = smooth_light_field(light_e=60.0, blur=1.5)
    assert brighter.surface(tmp_path / "surface", (300.0, 600.0)).picture.mean() > 1.5 * surface.picture.mean()
