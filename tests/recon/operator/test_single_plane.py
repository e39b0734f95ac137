"""H of a plane against the operator contract, and an independently built matrix; errors of its parts."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, plane_from_ray
from faintfield.calib.lens import Lens
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.placement import EDGE_TOLERANCE
from faintfield.recon.operator.single_plane import PlaneOperator
from tests.recon.operator_cases import FACING_AT_500_MM, Case, cases
from tests.recon.operator_contract import check_linear_operator, dense_matrix


def ray_hits(
    rays: NDArray[Any], rt_cam_ref: NDArray[Any], rt_ref_plane: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return where rays (…, 2) from the camera's centre meet the plane (…, 2) in mm, whether in front of the camera."""
    r_ref_cam = Rotation.from_rotvec(rt_cam_ref[:3]).as_matrix().T
    r_ref_plane = Rotation.from_rotvec(rt_ref_plane[:3]).as_matrix()
    centre, origin, normal = -r_ref_cam @ rt_cam_ref[3:], rt_ref_plane[3:], r_ref_plane[:, 2]
    directions = np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1) @ r_ref_cam.T
    path = (normal @ (origin - centre)) / (directions @ normal)
    return ((centre + path[..., np.newaxis] * directions - origin) @ r_ref_plane)[..., :2], path > 0


def matrix_by_ray_casting(case: Case) -> Image:
    """Return H (pixel of any view, sample): intersect each ray with the plane, weight samples by tents."""
    matrix = []
    (rows, columns), (detector_rows, detector_columns) = case.grid.shape, case.rays.shape[1:3]
    for view, lattice in enumerate(case.lattice_of_view):
        hits_mm, in_front = ray_hits(case.rays[lattice], case.rt_cam_ref[view], case.rt_ref_plane)
        for i in range(detector_rows):
            for j in range(detector_columns):
                column, row = (hits_mm[i, j] - case.grid.origin_mm) / case.grid.pitch_mm
                at = min(max(row, 0.0), rows - 1.0), min(max(column, 0.0), columns - 1.0)
                weights = np.outer(tent(at[0], rows), tent(at[1], columns)).ravel()
                outside = max(abs(at[0] - row), abs(at[1] - column)) > EDGE_TOLERANCE
                counts = in_front[i, j] and case.valid[view, i, j] and not outside
                matrix.append(weights * case.flat[lattice, i, j] if counts else 0 * weights)
    return np.stack(matrix)


def tent(at: float, samples: int) -> NDArray[np.float64]:
    """Return bilinear weights along one axis: that of each sample falls linearly to zero at its neighbours."""
    return np.maximum(0.0, 1.0 - np.abs(np.arange(samples) - at))


def looking_at(columns: ArrayLike, rows: ArrayLike, **options: Any) -> PlaneOperator:
    """Return one view whose pixels look at the given columns and rows, counted in samples, of a plane of 4 x 50."""
    rays = np.stack(np.meshgrid(np.asarray(columns, float), np.asarray(rows, float)), axis=-1)
    grid = PlaneGrid((4, 50), 1.0, (0.0, 0.0))
    return PlaneOperator(np.eye(3)[np.newaxis], rays, grid, **{"dtype": np.float64, **options})


@settings(max_examples=15)
@given(case=cases())
def test_every_case_keeps_the_operator_contract(case: Case) -> None:
    check_linear_operator(case.operator())


@pytest.mark.parametrize(("turn_rad", "workers"), [(0.0, 5), (0.01, 2)], ids=["contiguous blocks", "scattered blocks"])
def test_wide_views_at_scale_one_keep_contract(turn_rad: float, workers: int) -> None:
    rays = Lens((77, 11), 100.0, 100.0, 38.2, 5.1).rays()
    poses = np.array([[0.0, 0, 0, 0, 0, 0], [0, turn_rad, 0.5 * turn_rad, -31.0, 2.0, 0]])
    grid = PlaneGrid((5, 81), 5.0, (-205.0, -13.0))
    homographies = plane_from_ray(poses, FACING_AT_500_MM)
    check_linear_operator(PlaneOperator(homographies, rays, grid, dtype=np.float64, workers=workers))


@pytest.mark.parametrize("advance", [1, 2, 3])
def test_h_is_bilinear_in_blocks_halves_and_pixels(advance: int) -> None:
    generator = np.random.default_rng(advance)
    even = 0.3 + advance * np.arange(64.0)
    halves = np.concatenate([even[:32] + 40, even[32:] + 30.2])  # a jump, as between two halves in step
    columns = np.concatenate([even, halves, generator.uniform(0, 299, 64), even + 7.5, halves])
    rows = np.array([0.2, 1.0, 2.6])
    rays = np.stack(np.meshgrid(columns, rows), axis=-1)
    middle = rays.shape[1] // 2
    rays[1, middle - 1 : middle + 1, 0] = 50.0, 50.0 + advance  # the advance is that of the middle pixel
    operator = PlaneOperator(np.eye(3)[np.newaxis], rays, PlaneGrid((4, 300), 1.0, (0.0, 0.0)), dtype=np.float64)
    weights = np.stack([np.outer(tent(row, 4), tent(column, 300)).ravel() for column, row in rays.reshape(-1, 2)])
    plane, image = generator.normal(size=(4, 300)), generator.normal(size=(1, *rays.shape[:2]))
    np.testing.assert_allclose(operator.forward(plane).ravel(), weights @ plane.ravel(), atol=1e-9)
    np.testing.assert_allclose(operator.adjoint(image).ravel(), weights.T @ image.ravel(), atol=1e-9)


@settings(max_examples=20)
@given(case=cases(max_rows=7, max_columns=11))
def test_h_is_the_matrix_of_cast_rays(case: Case) -> None:
    np.testing.assert_allclose(dense_matrix(case.operator()), matrix_by_ray_casting(case), atol=1e-10)


@pytest.mark.parametrize("mirrored", [False, True], ids=["contiguous blocks", "scattered blocks"])
def test_pixels_on_the_last_sample_count(mirrored: bool) -> None:
    columns = np.arange(-3.0, 53.0)[:: -1 if mirrored else 1]
    operator = looking_at(columns, [-1, 0, 1, 2, 3, 4])
    plane = np.arange(200.0).reshape(4, 50) + 1
    expected = np.pad(plane, ((1, 1), (3, 3)))[:, :: -1 if mirrored else 1]
    np.testing.assert_array_equal(operator.forward(plane)[0], expected)
    np.testing.assert_array_equal(operator.sensitivity(), np.ones((4, 50)))


@pytest.mark.parametrize("overshoot", [-0.9, 0.9, -1.1, 1.1])
def test_pixel_sees_edge_only_within_tolerance(overshoot: float) -> None:
    beyond = overshoot * EDGE_TOLERANCE
    operator = looking_at([10.0, beyond if beyond < 0 else 49 + beyond], [1.0])
    edge = operator.forward(np.ones((4, 50)))[0, 0, 1]
    assert edge == (1.0 if abs(overshoot) < 1 else 0.0)


def test_overlaying_plane_is_seen_to_its_border() -> None:
    depth_mm = 613.3
    lens = Lens((640, 480), 800.3, 800.3, 322.8, 237.8)
    pitch_mm = depth_mm / lens.fx_px
    grid = PlaneGrid((480, 640), pitch_mm, (-lens.cx_px * pitch_mm, -lens.cy_px * pitch_mm))
    homographies = plane_from_ray(np.zeros((1, 6)), fronto_parallel_rt_ref_plane(depth_mm))
    operator = PlaneOperator(homographies, lens.rays(), grid)
    np.testing.assert_allclose(operator.forward(np.ones(grid.shape, np.float32)), 1.0, atol=1e-6)


def test_plane_behind_the_cameras_is_refused() -> None:
    lens, grid = Lens((30, 20), 40.0, 40.0, 14.2, 9.1), PlaneGrid((20, 30), 12.5, (-180.0, -110.0))
    homographies = plane_from_ray(np.array([[0.0] * 6, [0.02, 0.1, 0, 30, 5, 9]]), FACING_AT_500_MM)
    PlaneOperator(8 * homographies, lens.rays(), grid)
    with pytest.raises(GeometryMismatch, match="no pixel of any of the 2 views"):
        PlaneOperator(-homographies, lens.rays(), grid)


@pytest.mark.parametrize("mirrored", [False, True], ids=["contiguous blocks", "scattered blocks"])
def test_values_of_invalid_pixels_reach_no_sample(mirrored: bool) -> None:
    valid = np.ones((1, 4, 50), bool)
    valid[0, 2, 17] = False
    operator = looking_at(np.arange(50.0)[:: -1 if mirrored else 1], np.arange(4.0), valid=valid)
    electrons = np.where(valid, 2.0, np.nan)
    ratio = operator.adjoint_of_ratio(np.full((4, 50), 2.0), ElementalImages(electrons, valid=valid))
    for samples in (operator.adjoint(electrons) / 2, ratio):
        np.testing.assert_array_equal(samples, valid[0, :, :: -1 if mirrored else 1])


def test_ratio_is_zero_where_no_electron_is_expected() -> None:
    operator = looking_at(np.arange(50.0), np.arange(4.0))
    ratio = operator.adjoint_of_ratio(np.zeros((4, 50)), ElementalImages(np.ones((1, 4, 50))))
    np.testing.assert_array_equal(ratio, 0.0)


GOOD: dict[str, Any] = {
    "plane_from_ray": np.stack([np.eye(3)] * 2),
    "rays": np.zeros((2, 3, 4, 2)),
    "grid": PlaneGrid((5, 5), 1.0, (-2.0, -2.0)),
    "lattice_of_view": np.array([0, 1]),
}


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"plane_from_ray": np.eye(3)}, "do not fit"),
        ({"rays": np.zeros((2, 3, 4, 3))}, "do not fit"),
        ({"flat": np.ones((3, 3, 4))}, "flat"),
        ({"valid": np.zeros((1, 3, 4), bool)}, "valid"),
        ({"lattice_of_view": np.array([0, 2])}, "lattice_of_view"),
        ({"plane_from_ray": np.full((2, 3, 3), np.nan)}, "not a finite number"),
        ({"grid": PlaneGrid((5, 5), 1.0, (50.0, 0.0))}, "no pixel of any of the 2 views"),
    ],
)
def test_parts_that_do_not_fit_are_refused(bad: dict[str, Any], words: str) -> None:
    assert PlaneOperator(**GOOD).sensitivity().sum() == 24
    with pytest.raises(GeometryMismatch, match=words):
        PlaneOperator(**{**GOOD, **bad})


@pytest.mark.parametrize("views", [[-1], [0, 0], [True, False]])
def test_missing_and_repeated_views_are_refused(views: Any) -> None:
    operator = PlaneOperator(**GOOD)
    with pytest.raises(ValueError, match="views must"):
        operator.forward(np.ones((5, 5)), views)
    with pytest.raises(ValueError, match="views must"):
        operator.adjoint(np.ones((2, 3, 4)), views)


def test_arrays_of_another_shape_are_refused() -> None:
    operator = PlaneOperator(**GOOD)
    plane, images = np.ones((5, 5)), np.ones((2, 3, 4))
    uses: list[Callable[[], Image]] = [
        lambda: operator.forward(images[0]),
        lambda: operator.adjoint(images[:1]),
        lambda: operator.adjoint_of_map(plane),
        lambda: operator.adjoint_of_ratio(plane, ElementalImages(images, background_e=plane)),
    ]
    for use in uses:
        with pytest.raises(GeometryMismatch, match="shape"):
            use()
