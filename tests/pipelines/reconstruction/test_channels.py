"""From frames to electrons: offset, gain, saturation, colours and mosaics, and where a plane's samples lie."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.errors import InputError, UnreadableImage, WrongBitDepth, WrongSize
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from faintfield.pipelines.reconstruction.operators import OperatorFactory, default_pitch_px, plane_grid
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.solver.initialization import back_projection
from tests.pipelines.by_hand import channels_of, write_fitted_noise
from tests.pipelines.conftest import Edit, SetMaker

BAYER = ["RG", "GB"]


def _back_projected(folder: Path, depth_mm: float = 100.0) -> NDArray[np.floating]:
    elemental_set = load_set(folder)
    (layout,) = channel_layouts(elemental_set)
    images = load_channel(elemental_set, layout)
    operator = OperatorFactory(elemental_set, layout, images).at(depth_mm, plane_grid(elemental_set, depth_mm))
    return back_projection(operator, images)


def test_numbers_become_electrons_unless_saturated(make_set: SetMaker) -> None:
    noise = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0, "dark_current_e_per_s": 0.2}
    images = channels_of(make_set([np.array([[100, 103], [97, 65535]], np.uint16)], noise=noise))["grey"]
    assert images.electrons.dtype == np.float32
    assert images.electrons.tolist() == [[[0.0, 1.5], [-1.5, 32717.5]]]
    assert images.background_e == pytest.approx(0.1, rel=1e-12)  # 0.2 e⁻/s in 0.5 s
    assert images.read_variance_e2 == pytest.approx(9 + 1 / 48, rel=1e-12)  # and rounding to 0.5 e⁻
    assert images.valid is None
    views = [np.full((2, 3), 500, np.uint16), np.array([[500, 999, 1000], [1001, 500, 500]], np.uint16)]
    noise = {"offset_dn": 0.0, "gain_dn_per_e": 1.0, "read_noise_e": 1.0, "saturation_dn": 1000.0}
    valid = channels_of(make_set(views, name="saturated", noise=noise))["grey"].valid
    assert valid is not None
    assert valid.tolist() == [[[True] * 3] * 2, [[True, True, False], [False, True, True]]]


@pytest.mark.parametrize(
    ("image", "failure", "words"),
    [
        (np.zeros((16, 12), np.uint16), WrongSize, r"is 12 x 16 px"),
        (np.zeros((12, 16), np.uint8), WrongBitDepth, r"has 8 bits per pixel, but .* saturates at 65535 DN"),
        (np.zeros((12, 16), np.float32), WrongBitDepth, r"holds float32 pixels"),
        (np.zeros((12, 16, 3), np.uint16), UnreadableImage, r"is colour, unlike the set's first view"),
    ],
)
def test_view_unlike_its_set_is_refused_by_name(
    image: NDArray[Any], failure: type[InputError], words: str, make_set: SetMaker,
    grey_images: Sequence[NDArray[np.uint16]],
) -> None:  # fmt: skip
    noise = {"offset_dn": 0.0, "gain_dn_per_e": 1.0, "read_noise_e": 1.0, "saturation_dn": 65535.0}
    folder = make_set(grey_images, noise=noise)
    tifffile.imwrite(folder / "view_1.tiff", image, photometric="rgb" if image.ndim == 3 else "minisblack")
    with pytest.raises(failure, match=rf"view_1\.tiff: {words}"):
        channels_of(folder)


def test_each_colour_of_rgb_frames_is_channel(make_set: SetMaker) -> None:
    views = list(np.random.default_rng(1).integers(100, 900, (2, 5, 6, 3)).astype(np.uint16))
    channels = channels_of(make_set(views))
    assert list(channels) == ["red", "green", "blue"]
    for index, images in enumerate(channels.values()):
        np.testing.assert_allclose(images.electrons, (np.stack(views)[..., index] - 100.0) / 2.0)


def test_each_mosaic_phase_is_lattice_of_its_colour(make_set: SetMaker) -> None:
    first, second = np.random.default_rng(1).integers(100, 900, (2, 5, 7)).astype(np.uint16)  # incomplete periods
    folder = make_set([first, second], camera={"mosaic": BAYER})
    phases_of = {"red": [(0, 0)], "green": [(0, 1), (1, 0)], "blue": [(1, 1)]}
    layouts = channel_layouts(load_set(folder))
    assert {layout.name: [lattice.first for lattice in layout.lattices] for layout in layouts} == phases_of
    channels = channels_of(folder)
    for name, phases in phases_of.items():
        # View by view, and within a view phase by phase
        expected = [view[row:4:2, column:6:2] for view in (first, second) for row, column in phases]
        np.testing.assert_allclose(channels[name].electrons, (np.stack(expected) - 100.0) / 2.0)


def test_maps_of_noise_follow_lattices(make_set: SetMaker) -> None:
    frame = np.random.default_rng(2).integers(90, 200, (4, 6)).astype(np.uint16)
    folder = make_set([frame], camera={"mosaic": BAYER}, noise="noise.json", exposure_s=2.0)
    write_fitted_noise(folder)
    offset, dark, gain, read_e = np.random.default_rng(1).uniform(1.5, 9, (4, 4, 6)).astype(np.float32)
    maps = {"offset_dn": offset, "dark_current_e_per_s": dark, "gain_dn_per_e": gain, "read_noise_e": read_e}
    np.savez(folder / "noise_maps.npz", allow_pickle=False, **maps)
    green = channels_of(folder)["green"]

    def lattices(pixels: NDArray[np.floating]) -> list[NDArray[np.floating]]:
        return [pixels[0::2, 1::2], pixels[1::2, 0::2]]

    np.testing.assert_allclose(green.electrons, lattices((frame - offset) / gain), rtol=1e-5)
    np.testing.assert_allclose(green.background_e, lattices(2 * dark), rtol=1e-5)
    np.testing.assert_allclose(green.read_variance_e2, lattices(read_e**2 + 1 / (12 * gain**2)), rtol=1e-5)


def test_hot_pixels_do_not_reach_plane(make_set: SetMaker, grey_images: Sequence[NDArray[np.uint16]]) -> None:
    planes = []
    for name, level in (("cold", 100), ("hot", 60_000)):
        images = [image.copy() for image in grey_images]
        for image in images:
            image[5, 9] = level
        folder = make_set(images, name=name, noise="noise.json")
        write_fitted_noise(folder, {"dark_current_e_per_s": 0.0}, hot_pixels=[[5, 9]])
        planes.append(_back_projected(folder))
    np.testing.assert_array_equal(planes[0], planes[1])
    assert planes[0].max() > 100


def test_flat_field_is_divided_out(make_set: SetMaker) -> None:
    response = np.linspace(0.3, 1.0, 12 * 16, dtype=np.float32).reshape(12, 16)
    frame = np.rint(1000.0 * response).astype(np.uint16)
    noise = {"offset_dn": 0.0, "gain_dn_per_e": 1.0, "read_noise_e": 0.0}
    folder = make_set([frame], camera={"flat": "flat.tiff"}, noise=noise)
    tifffile.imwrite(folder / "flat.tiff", response)
    np.testing.assert_allclose(_back_projected(folder), 1000.0, rtol=0.5 / 300)  # frames are rounded to whole DN


@pytest.mark.parametrize("depth_mm", [40.0, 700.0])
def test_plane_overlays_reference_view_pixel_for_pixel(depth_mm: float, make_set: SetMaker) -> None:
    frame = np.random.default_rng(1).integers(100, 60_000, (12, 16)).astype(np.uint16)
    noise = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0, "dark_current_e_per_s": 4.0}
    folder = make_set([frame], camera={"cx_px": 3.3, "cy_px": 9.1}, noise=noise, exposure_s=0.5)
    plane = _back_projected(folder, depth_mm)
    assert plane.shape == frame.shape
    # Interior: at the border half a sample lies outside
    np.testing.assert_allclose(plane[1:-1, 1:-1], (frame[1:-1, 1:-1] - 100.0) / 2.0 - 2.0, rtol=1e-3)


@pytest.mark.parametrize(("depth_mm", "centre"), [(0.5, (6.2, 7.7)), (1e6, (9.5, 2.25))])
def test_samples_overlay_undistorted_pixels_of_reference_view(
    depth_mm: float, centre: tuple[float, float], make_set: SetMaker, grey_images: Sequence[NDArray[np.uint16]],
    edit: Edit,
) -> None:  # fmt: skip
    folder = make_set(grey_images, camera={"fx_px": 40.0, "fy_px": 40.0, "cx_px": 6.2, "cy_px": 7.7})
    edit(folder, lambda settings: settings["view"][0].update(cx_px=centre[0], cy_px=centre[1]))
    grid, finer = (plane_grid(load_set(folder), depth_mm, pitch_mm=pitch) for pitch in (None, depth_mm / 160))
    assert (grid.shape, finer.shape) == ((12, 16), (48, 64))
    for axis in (0, 1):
        edge = grid.origin_mm[axis] - grid.pitch_mm / 2
        assert finer.origin_mm[axis] - finer.pitch_mm / 2 == pytest.approx(edge, rel=1e-9)
    assert grid.pitch_mm == pytest.approx(depth_mm / 40.0, rel=1e-12)
    for column, row in [(0.0, 0.0), (15.0, 11.0), (6.2, 3.0)]:
        x_mm, y_mm = depth_mm * (column - centre[0]) / 40.0, depth_mm * (row - centre[1]) / 40.0
        np.testing.assert_allclose(grid.index_from_plane() @ [x_mm, y_mm, 1.0], [column, row, 1.0], atol=1e-9)


@pytest.mark.parametrize(("views", "pitch_px"), [(1, 2), (3, 2), (4, 1)])
def test_few_mosaic_views_have_samples_per_period(views: int, pitch_px: int, make_set: SetMaker) -> None:
    elemental_set = load_set(make_set([np.zeros((4, 6), np.uint16)] * views, camera={"mosaic": BAYER}))
    assert default_pitch_px(elemental_set) == pitch_px


def test_views_with_own_principal_points(make_set: SetMaker, edit: Edit) -> None:
    """Two pictures aligned on a plane: what is at the same pixel of both is on it."""
    frame = np.random.default_rng(1).integers(100, 60_000, (12, 16)).astype(np.uint16)
    folder = make_set([frame, frame])
    # At 100 mm a point moves by −50 · 10 / 100 = −5 px to the second camera; its picture was moved back by as much
    edit(folder, lambda settings: settings["view"][1].update(cx_px=settings["camera"]["cx_px"] + 5.0))
    plane = _back_projected(folder, 100.0)
    np.testing.assert_allclose(plane[1:-1, 1:-1], (frame[1:-1, 1:-1] - 100.0) / 2.0, rtol=1e-3)
    edit(folder, lambda settings: settings["view"][1].update(cx_px=settings["camera"]["cx_px"]))
    moved = _back_projected(folder, 100.0)
    expected = ((frame[1:-1, 6:-1] - 100.0) / 2.0 + (frame[1:-1, 1:-6] - 100.0) / 2.0) / 2.0
    np.testing.assert_allclose(moved[1:-1, 6:-1], expected, rtol=1e-3)
    edit(folder, lambda settings: settings["camera"].update(distortion=[-0.1]))
    _back_projected(folder)
    edit(folder, lambda settings: settings["view"][1].update(cx_px=9.0))
    with pytest.raises(GeometryMismatch, match=r"view\[1\] has a principal point of its own .* distortion \[-0\.1\]"):
        _back_projected(folder)


def test_bin_with_unusable_pixel_does_not_count(make_set: SetMaker) -> None:
    folder = make_set([np.full((12, 16), 500, np.uint16)] * 2)
    unusable = np.zeros((12, 16), bool)
    unusable[5, 9] = True
    elemental_set = replace(load_set(folder), unusable=unusable)
    (layout,) = channel_layouts(elemental_set)
    images = load_channel(elemental_set, layout).binned(4)
    factory = OperatorFactory(elemental_set, layout, images, bins=4)
    grid = plane_grid(elemental_set, 100.0).binned(4)
    seen = factory.at(100.0, grid).forward(np.ones(grid.shape, np.float32), [0])[0]
    assert seen[1, 2] == 0
    assert np.count_nonzero(seen) == seen.size - 1
