"""Homographies against points of the plane carried through space."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from faintfield.calib.homography import (
    fronto_parallel_rt_ref_plane,
    image_lattice,
    plane_from_ray,
    transfer,
    transfer_sigma_px,
)
from faintfield.calib.lens import Lens

poses = st.integers(0, 2**32 - 1).map(
    lambda seed: np.random.default_rng(seed).uniform(-1, 1, (3, 6)) * np.repeat([0.5, 200.0], 3)
)
planes = st.tuples(st.integers(0, 2**32 - 1), st.sampled_from([60.0, 500.0, 50_000.0])).map(
    lambda drawn: np.append(np.random.default_rng(drawn[0]).uniform(-1, 1, 5) * [0.9, 0.9, 3.1, 50, 50], drawn[1])
)
POINTS_MM = np.random.default_rng(1).uniform(-80, 80, (40, 2))


def in_camera(rt_cam_ref: NDArray[np.float64], rt_ref_plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Carry the points from the plane to the reference and on to the camera, (point, 3)."""
    in_ref = Rotation.from_rotvec(rt_ref_plane[:3]).apply(np.pad(POINTS_MM, ((0, 0), (0, 1)))) + rt_ref_plane[3:]
    return Rotation.from_rotvec(rt_cam_ref[:3]).apply(in_ref) + rt_cam_ref[3:]


@given(rt_cam_ref=poses, rt_ref_plane=planes)
def test_rays_are_mapped_to_points_of_the_plane(
    rt_cam_ref: NDArray[np.float64], rt_ref_plane: NDArray[np.float64]
) -> None:
    for homography, rt in zip(plane_from_ray(rt_cam_ref, rt_ref_plane), rt_cam_ref, strict=True):
        points = in_camera(rt, rt_ref_plane)
        depths_mm = points[:, 2]
        mapped = (points / points[:, 2:]) @ homography.T
        np.testing.assert_allclose(mapped[:, 2], 1 / depths_mm, rtol=1e-7)
        np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], POINTS_MM, rtol=1e-7, atol=1e-6)


def test_plane_from_its_back_keeps_positive_scale() -> None:
    from_behind = np.array([0.0, np.pi, 0.0, 0.0, 0.0, 500.0])
    column, row, scale = plane_from_ray(np.zeros((1, 6)), from_behind)[0] @ [0.1, 0.2, 1.0]
    assert scale > 0
    assert (column / scale, row / scale) == pytest.approx((-50.0, 100.0))


@pytest.mark.parametrize("plane", [[0, 0, 0, 0, 0, 0.0], [0, np.pi / 2, 0, 0, 0, 500.0]], ids=["through", "edge on"])
def test_camera_within_the_plane_sees_nothing(plane: list[float]) -> None:
    np.testing.assert_array_equal(plane_from_ray(np.zeros((1, 6)), np.array(plane)), np.zeros((1, 3, 3)))


@given(rt_cam_ref=poses)
def test_views_may_have_their_own_principal_points(
    rt_cam_ref: NDArray[np.float64],
) -> None:
    f_px, centre, centres = 800.0, np.array([319.5, 239.5]), np.array([[330.0, 250.0], [319.5, 239.5], [100.0, -20.0]])
    rt_ref_plane = fronto_parallel_rt_ref_plane(500.0)
    homographies = plane_from_ray(rt_cam_ref, rt_ref_plane, (centre - centres) / f_px)
    for homography, rt, own_centre in zip(homographies, rt_cam_ref, centres, strict=True):
        points = in_camera(rt, rt_ref_plane)
        pixels = f_px * points[:, :2] / points[:, 2:] + own_centre
        rays = np.column_stack([(pixels - centre) / f_px, np.ones(len(pixels))])  # as the shared ray map has them
        mapped = rays @ homography.T
        np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], POINTS_MM, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(("size_px", "across"), [((640, 480), 5), ((5, 3), 4)])
def test_lattice_holds_middles_of_equal_parts(size_px: tuple[int, int], across: int) -> None:
    """Pixel 0 reaches from −½ to ½: cut into 20 pieces each, the pixels of a part have their mean in its middle."""
    columns, rows = ((-0.5 + (np.arange(20 * size) + 0.5) / 20).reshape(across, -1).mean(axis=1) for size in size_px)
    expected = [(column, row) for row in rows for column in columns]
    np.testing.assert_allclose(image_lattice(size_px, across), expected, atol=1e-12)


LENS = Lens((640, 480), 800.0, 790.0, 321.0, 238.0, (-0.1, 0.05, 1e-3, -5e-4))
VIEW = np.array([0.02, -0.05, 0.1, 30.0, -20.0, 5.0])
TILTED = np.array([0.2, -0.3, 0.1, 10.0, -5.0, 600.0])


def test_point_is_transferred_to_its_image() -> None:
    in_ref, in_view = in_camera(np.zeros(6), TILTED), in_camera(VIEW, TILTED)
    np.testing.assert_allclose(transfer(LENS, VIEW, TILTED, LENS.project(in_ref)), LENS.project(in_view), atol=1e-5)


@pytest.mark.parametrize("plane", [[0, 0, 0, 0, 0, -500.0], [0, np.pi / 2, 0, 5, 0, 0.0]], ids=["behind", "beside"])
def test_plane_not_in_front_transfers_nothing(plane: list[float]) -> None:
    pixels = np.array([[100.0, 200.0]])  # looks away from the plane beside
    assert np.isnan(transfer(LENS, np.zeros(6), np.array(plane), pixels)).all()


def test_transfer_sigma_is_that_of_drawn_cameras() -> None:
    generator = np.random.default_rng(3)
    scales = np.array([0.8, 0.7, 0.5, 0.4, 1e-3, 2e-3, 1e-4, 1e-4, *[2e-4] * 3, *[0.05] * 3])
    mixing = np.eye(14) + 0.3 * generator.normal(size=(14, 14))
    root = scales[:, None] * mixing
    pixels = np.array([[150.0, 100.0], [320.0, 240.0], [500.0, 400.0]])
    stated = transfer_sigma_px(LENS, VIEW[None], [root @ root.T], TILTED, pixels)[0]
    truth = transfer(LENS, VIEW, TILTED, pixels)
    squares = np.zeros(3)
    for _ in range(1000):
        drawn = np.array([*LENS.parameters, *VIEW]) + root @ generator.normal(size=14)
        lens = Lens.from_parameters(LENS.size_px, drawn[:8])
        squares += ((transfer(lens, drawn[8:], TILTED, pixels) - truth) ** 2).sum(axis=1)
    np.testing.assert_allclose(stated, np.sqrt(squares / 1000), rtol=0.06)


def test_sigma_ends_at_the_edges_of_the_view() -> None:
    pinhole = Lens((640, 480), 800.0, 800.0, 319.5, 239.5)
    # The view stands 50 mm to the right: a plane at 400 mm moves by 100 px to the left
    view, plane = np.array([0.0, 0, 0, -50.0, 0, 0]), fronto_parallel_rt_ref_plane(400.0)
    pixels = np.array([[99.4, 100], [99.6, 100], [739.4, 100], [739.6, 100], [300, -0.6], [300, -0.4], [300, 479.6]])
    np.testing.assert_allclose(transfer(pinhole, view, plane, pixels), pixels - [100.0, 0.0], atol=1e-9)
    sigma_px = transfer_sigma_px(pinhole, view[None], [1e-4 * np.eye(10)], plane, pixels)[0]
    assert np.isfinite(sigma_px).tolist() == [False, True, True, False, False, True, False]
