"""The light of all colours in bins, as pinhole cameras see it, from frames made by hand."""

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.depth.search import default_bins, luminance
from faintfield.recon.surface.pinhole_views import UNKNOWN
from tests.pipelines.by_hand import write_fitted_noise
from tests.pipelines.conftest import Edit, SetMaker

BAYER = ["RG", "GB"]
NOISE = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0, "dark_current_e_per_s": 8.0}
BACKGROUND_E, READ_VARIANCE_E2 = 4.0, 9 + 1 / 48  # in 0.5 s; rounding to 0.5 e⁻


def _frames(*shape: int) -> list[NDArray[np.uint16]]:
    return list(np.random.default_rng(1).integers(100, 900, (2, *shape)).astype(np.uint16))


@pytest.mark.parametrize(
    ("mosaic", "bins", "colours"),
    [(None, 3, ()), (BAYER, 4, ()), (["RGB"], 3, ()), (["RGGB", "GBRG"], 4, ()), (None, 2, (3,))],
)
def test_bins_add_pixels_of_all_colours(
    mosaic: list[str] | None, bins: int, colours: tuple[int, ...], make_set: SetMaker
) -> None:
    frames = _frames(14, 18, *colours)
    views = luminance(load_set(make_set(frames, noise=NOISE, camera={"mosaic": mosaic} if mosaic else None)), bins)
    assert views.light_e.dtype == np.float32
    rows, columns = 14 // bins, 18 // bins
    for light, frame in zip(views.light_e, frames, strict=True):
        electrons = (frame[: rows * bins, : columns * bins] - 100.0) / 2.0 - BACKGROUND_E
        expected = electrons.reshape(rows, bins, columns, bins, -1).sum(axis=(1, 3, 4))
        np.testing.assert_allclose(light, expected, rtol=1e-5, atol=1e-3)
    samples = bins**2 * (3 if colours else 1)
    assert views.variance_e2 == pytest.approx(samples * (BACKGROUND_E + READ_VARIANCE_E2), rel=1e-6)


@pytest.mark.parametrize("mosaic", [None, BAYER])
def test_saturated_and_hot_pixels_hide_their_bins(mosaic: list[str] | None, make_set: SetMaker) -> None:
    frames = _frames(8, 10)
    frames[1][5, 2] = 1000
    folder = make_set(frames, noise="noise.json", camera={"mosaic": mosaic} if mosaic else None)
    write_fitted_noise(folder, NOISE | {"saturation_dn": 1000.0}, hot_pixels=[[1, 7]])
    views = luminance(load_set(folder), 2)
    assert np.argwhere(views.light_e == UNKNOWN).tolist() == [[0, 0, 3], [1, 0, 3], [1, 2, 1]]
    assert views.light_e[views.light_e != UNKNOWN].min() > -100


def test_response_is_divided_out(make_set: SetMaker) -> None:
    response = np.linspace(0.3, 1.0, 12 * 16, dtype=np.float32).reshape(12, 16)
    noise = {"offset_dn": 0.0, "gain_dn_per_e": 1.0, "read_noise_e": 0.0}
    folder = make_set([np.rint(1000.0 * response).astype(np.uint16)], camera={"flat": "flat.tiff"}, noise=noise)
    tifffile.imwrite(folder / "flat.tiff", response)
    np.testing.assert_allclose(luminance(load_set(folder), 2).light_e, 4000.0, rtol=0.5 / 300)


DISTORTION = [-0.25, 0.08, 0.004, -0.003]
LENS = {"fx_px": 62.0, "fy_px": 60.0, "cx_px": 33.0, "cy_px": 22.5}


@pytest.mark.parametrize("bins", [1, 2])
@pytest.mark.parametrize("ray", [(-0.35, -0.2), (0.36, -0.25)])
def test_point_lands_where_pinhole_camera_sees_it(ray: tuple[float, float], bins: int, make_set: SetMaker) -> None:
    camera_matrix = np.array([[62.0, 0, 33.0], [0, 60.0, 22.5], [0, 0, 1]])
    origin = np.zeros(3)
    seen = cv2.projectPoints(np.array([[*ray, 1.0]]), origin, origin, camera_matrix, np.array(DISTORTION))[0].ravel()
    row, column = np.indices((48, 64))
    spot = 4000 * np.exp(-((column - seen[0]) ** 2 + (row - seen[1]) ** 2) / (2 * 1.6**2))
    noise = {"offset_dn": 100.0, "gain_dn_per_e": 1.0, "read_noise_e": 1.0}
    folder = make_set([np.rint(100 + spot).astype(np.uint16)], noise=noise, camera=LENS | {"distortion": DISTORTION})
    views = luminance(load_set(folder), bins)
    light = np.where(views.light_e[0] == UNKNOWN, 0, views.light_e[0])
    centre = [np.sum(index * light) / light.sum() for index in np.indices(light.shape)[::-1]]
    expected = [
        ((size * at + middle) + 0.5) / bins - 0.5 for size, at, middle in zip((62, 60), ray, (33, 22.5), strict=True)
    ]
    np.testing.assert_allclose(centre, expected, atol=0.12 / bins)
    assert np.hypot(*(seen - [62 * ray[0] + 33, 60 * ray[1] + 22.5])) > 0.5
    # And that is where the views say that they look
    np.testing.assert_allclose(views.pixel_from_surface[0] @ [*ray, 1, 0], [*expected, 1], rtol=1e-5)


def test_variance_counts_response_and_resampling(make_set: SetMaker) -> None:
    """The noise of light that the lens darkens and distorts: as drawn, on average over the picture."""
    generator, response = np.random.default_rng(3), np.linspace(0.4, 1, 64, dtype=np.float32) * np.ones((48, 1))
    frames = [np.rint(100 + 2 * (generator.poisson(80 * response) + generator.normal(0, 3, (48, 64)))) for _ in "1234"]
    noise = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0}
    camera = LENS | {"distortion": [-0.25], "flat": "flat.tiff"}
    folder = make_set([frame.astype(np.uint16) for frame in frames], noise=noise, camera=camera)
    tifffile.imwrite(folder / "flat.tiff", response.astype(np.float32))
    views = luminance(load_set(folder), 1)
    squares = np.square(views.light_e - 80) / views.pixel_variance(np.full((48, 64), 80.0))
    assert squares[views.light_e != UNKNOWN].mean() == pytest.approx(1, abs=0.06)  # 4σ of 12 000 pixels


def test_beyond_picture_and_beside_unknown_is_unknown(make_set: SetMaker) -> None:
    folder = make_set([np.full((48, 64), 900, np.uint16)], camera=LENS | {"distortion": [0.3]})
    light = luminance(load_set(folder), 1).light_e[0]
    assert light[24, 32] == pytest.approx(400)
    assert (light[[0, 0, -1, -1], [0, -1, 0, -1]] == UNKNOWN).all()
    assert set(np.unique(light)) == {UNKNOWN, np.float32(400)}
    frame = np.full((48, 64), 900, np.uint16)
    frame[24, 50] = 4000
    noise = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0, "saturation_dn": 4000.0}
    folder = make_set([frame], name="saturated", noise=noise, camera=LENS | {"distortion": [-0.1]})
    light = luminance(load_set(folder), 1).light_e[0]
    unknown = np.argwhere(light == UNKNOWN)
    assert 1 <= len(unknown) <= 9
    assert np.abs(unknown - [24, 50]).max() <= 2
    np.testing.assert_allclose(light[light != UNKNOWN], 400, rtol=1e-5)


def test_views_follow_pose_and_principal_point(make_set: SetMaker, edit: Edit) -> None:
    folder = make_set(_frames(12, 16), camera={"cx_px": 6.0, "cy_px": 7.0})
    edit(folder, lambda settings: settings["view"][1].update(cx_px=9.5, cy_px=2.25))
    views = luminance(load_set(folder), 2)
    # 100 mm in front of the reference camera, 10 mm from the second one's axis: f = 50 px
    point = np.array([20.0, -12.0, 100.0])
    for matrix, centre, x_mm in zip(views.pixel_from_surface, [(6.0, 7.0), (9.5, 2.25)], (20.0, 10.0), strict=True):
        place = matrix @ [*point / 100, 1 / 100]
        pixel = np.array([50 * x_mm / 100 + centre[0], 50 * -12 / 100 + centre[1]])
        np.testing.assert_allclose(place[:2] / place[2], (pixel + 0.5) / 2 - 0.5, rtol=1e-5)
    assert views.grid.shape == (6, 8)


@pytest.mark.parametrize(
    ("size", "mosaic", "bins"),
    [((64, 48), None, 1), ((64, 48), BAYER, 2), ((64, 48), ["RGGB", "GBRG"], 4), ((1040, 780), None, 4)],
)
def test_bins_hold_whole_periods(
    size: tuple[int, int], mosaic: list[str] | None, bins: int, make_set: SetMaker
) -> None:
    frame = np.zeros(size[::-1], np.uint16)
    assert default_bins(load_set(make_set([frame], camera={"mosaic": mosaic} if mosaic else None))) == bins
