"""Films of scenes whose view from elsewhere is known in closed form: two planes, and a slanted one."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.pipelines.reconstruction.surface.parallax import aperture_of, render_parallax, viewpoints

SHAPE, PITCH = (120, 160), 1 / 200
NEAR, FAR = 1 / 400, 1 / 800  # a mm of viewpoint moves them by 0.25 px against each other
BOX = (slice(40, 80), slice(60, 100))


def _two_planes() -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return picture and 1/depth of a white box before a wall of noise, grey levels 20 to 120."""
    picture = np.random.default_rng(3).integers(20, 121, SHAPE).astype(np.uint8)
    inverse_depth = np.full(SHAPE, FAR)
    picture[BOX], inverse_depth[BOX] = 255, NEAR
    return picture, inverse_depth


@pytest.mark.parametrize("moved_px", [(-12, 0), (8, -8)])
def test_box_moves_whole_before_wall(moved_px: tuple[int, int]) -> None:
    picture, inverse_depth = _two_planes()
    offset_mm = -4.0 * np.array([moved_px])  # a camera that moves right sees near things move left
    (frame,) = render_parallax(picture, inverse_depth, PITCH, offset_mm)
    cut_x, cut_y = map(abs, moved_px)
    assert frame.shape == (120 - 2 * cut_y, 160 - 2 * cut_x)
    # The middle depth, the wall's, stands still
    expected = picture.copy()
    expected[BOX] = 0
    box = np.zeros(SHAPE, bool)
    box[40 + moved_px[1] : 80 + moved_px[1], 60 + moved_px[0] : 100 + moved_px[0]] = True
    part = slice(cut_y, 120 - cut_y), slice(cut_x, 160 - cut_x)
    expected, box = expected[part], box[part]
    rounded = 16  # corners that the median of the depths takes away
    assert np.count_nonzero(frame[box] != 255) <= rounded
    assert np.count_nonzero(frame[~box] > 120) <= rounded  # neither a second box nor a sheet between both
    beside = ~box & (expected > 0)
    assert np.mean(frame[beside] == expected[beside]) > 0.97  # all but a rim around the box
    uncovered = ~box & (expected == 0)
    assert uncovered.sum() > 300
    assert 50 < frame[uncovered].mean() < 90  # as bright as the wall
    assert frame[uncovered].std() > 20  # and as rough


def test_mixed_light_of_edge_stays_with_neither() -> None:
    picture, inverse_depth = _two_planes()
    rim = np.zeros(SHAPE, bool)
    rim[39:81, 59:101] = True
    rim[BOX] = False
    picture[rim] = 190
    (frame,) = render_parallax(picture, inverse_depth, PITCH, np.array([[-48.0, 0.0]]))
    wall = np.ones(SHAPE, bool)
    wall[38:82, 70:114] = False
    assert not (frame[wall[:, 12:-12]] > 120).any()


def test_slanted_plane_has_no_cracks() -> None:
    rows, columns = np.indices(SHAPE, float)
    inverse_depth = 1 / 800 + (1 / 400 - 1 / 800) * columns / 159

    def texture(at: NDArray[np.float64]) -> NDArray[np.float64]:
        return 128 + 100 * np.sin(at / 9) * np.cos(rows / 7)

    picture = np.rint(texture(columns)).astype(np.uint8)
    offset_mm = 40.0
    (frame,) = render_parallax(picture, inverse_depth, PITCH, np.array([[-offset_mm, 0.0]]))
    # x' = x + offset (1/z(x) - middle) / pitch, and 1/z is linear in x
    slope = (1 / 400 - 1 / 800) / 159 * offset_mm / PITCH
    source = (columns + slope * 79.5) / (1 + slope)
    cut = (160 - frame.shape[1]) // 2
    error = frame - texture(source)[:, cut : 160 - cut]
    assert 4 <= cut <= 6
    assert np.abs(error[:, 3:-3]).max() < 4


def test_colours_and_view_from_place_of_picture() -> None:
    picture, inverse_depth = _two_planes()
    (still,) = render_parallax(picture, inverse_depth, PITCH, np.zeros((1, 2)))
    np.testing.assert_array_equal(still, picture)
    colours = np.dstack([picture, picture // 2, picture // 4])
    (frame,) = render_parallax(colours, inverse_depth, PITCH, np.array([[20.0, 0.0]]))
    (grey,) = render_parallax(picture, inverse_depth, PITCH, np.array([[20.0, 0.0]]))
    np.testing.assert_array_equal(frame[:, :, 0], grey)
    assert frame.shape == (*grey.shape, 3)


def test_large_picture_is_reduced_and_strip_stays() -> None:
    picture = np.random.default_rng(1).integers(0, 255, (600, 800)).astype(np.uint8)
    ramp = np.linspace(FAR, NEAR, 600 * 800).reshape(600, 800)
    frames = render_parallax(picture, ramp, 1 / 1000, np.array([[5.0, 0.0], [0.0, 5.0]]))
    assert {frame.shape[1] for frame in frames} == {480}
    assert len({frame.shape for frame in frames}) == 1
    picture = np.zeros((24, 700), np.uint8)
    ramp = np.tile(np.linspace(FAR, NEAR, 700), (24, 1))
    frames = render_parallax(picture, ramp, 1 / 1000, viewpoints(ramp, 1 / 1000, (0.0, 300.0)))
    assert min(frames[0].shape) >= 8


@pytest.mark.parametrize("aperture_mm", [(300.0, 200.0), (2.0, 1.0), (100.0, 0.0)])
def test_viewpoints_circle_inside_the_nodes(aperture_mm: tuple[float, float]) -> None:
    _, inverse_depth = _two_planes()
    inverse_depth[:, 80:] = NEAR
    inverse_depth[:, 40:80] = (NEAR + FAR) / 2
    places = viewpoints(inverse_depth, PITCH, aperture_mm)
    assert (np.abs(places).max(axis=0) <= np.array(aperture_mm) / 2 + 1e-9).all()
    np.testing.assert_allclose(places.mean(axis=0), 0, atol=1e-9)
    steps = np.linalg.norm(np.roll(places, -1, axis=0) - places, axis=1)
    assert steps[-1] <= steps[:-1].max() * (1 + 1e-9)
    farthest_px = np.abs(places).max() * (NEAR - FAR) / 2 / PITCH
    assert farthest_px <= 0.03 * 160 * 1.01
    if aperture_mm[0] == 300.0:
        assert np.ptp(places[:, 0]) / np.ptp(places[:, 1]) == pytest.approx(1.5, rel=1e-6)
    elif aperture_mm[0] == 2.0:
        assert np.ptp(places[:, 0]) == pytest.approx(2.0)  # as far as the nodes


def test_aperture_is_that_of_centres_of_turned_cameras() -> None:
    generator = np.random.default_rng(9)
    centres = np.array([[-150.0, 20.0, 1.0], [100.0, -80.0, -2.0], [0.0, 120.0, 3.0]])
    poses = np.zeros((3, 6))
    for pose, centre in zip(poses, centres, strict=True):
        pose[:3] = generator.uniform(-0.4, 0.4, 3)
        pose[3:] = -cv2.Rodrigues(pose[:3])[0] @ centre
    np.testing.assert_allclose(aperture_of(poses), (250, 200), rtol=1e-9)
