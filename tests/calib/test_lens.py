"""Rays against OpenCV's projection, and against the simulated world's own inversion."""

import tracemalloc
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from faintfield.calib.errors import LensNotInvertible
from faintfield.calib.lens import Lens

DISTORTIONS: list[tuple[float, ...]] = [
    (),
    (-0.2,),
    (-0.2, 0.05, 1e-3, -2e-3, 0.01),
    (0.2, -0.1, -1e-3, 2e-3, 0.02, 0.3, -0.05, 0.01),
]


def lens_of(distortion: tuple[float, ...]) -> Lens:
    return Lens((61, 43), 70.0, 72.5, 28.4, 22.1, distortion)


def pixels_of(lens: Lens) -> NDArray[np.float64]:
    """All pixels (point, 2) as column, row."""
    rows, columns = np.divmod(np.arange(lens.size_px[0] * lens.size_px[1]), lens.size_px[0])
    return np.column_stack([columns, rows]).astype(float)


def images_of(lens: Lens, rays: NDArray[np.floating]) -> NDArray[np.float64]:
    """The pixels (point, 2) of rays by OpenCV."""
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    padded = np.array([*lens.distortion, *[0.0] * (8 - len(lens.distortion))])
    points = np.column_stack([7.0 * rays.reshape(-1, 2), np.full(rays.size // 2, 7.0)])
    return np.asarray(cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, padded)[0][:, 0])


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_rays_are_the_inverse_of_opencvs_projection(distortion: tuple[float, ...]) -> None:
    lens = lens_of(distortion)
    pixels = pixels_of(lens)
    np.testing.assert_allclose(images_of(lens, lens.rays_at(pixels)), pixels, atol=1e-8)
    # 70 px · 0.5 rounded to single precision is off by 2e-6 px
    np.testing.assert_allclose(images_of(lens, lens.rays()), pixels, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("distortion", "fx_px", "least", "most"),
    [
        ((-0.01,), 800.0, 0.0, 0.01),
        ((-0.2, 0.05, 1e-3, -2e-3, 0.01), 350.0, 0.01, 0.1),
        ((0.2, -0.1, -1e-3, 2e-3, 0.02, 0.3, -0.05, 0.01), 350.0, 0.01, 0.2),
        ((8.0, 2.0, 1e-3, 1e-3, 0.1, 8.4, 4.0, 0.6), 180.0, 1.0, 1.1),
    ],
    ids=["weak", "strong", "rational", "every pixel is a node"],
)
def test_strong_distortion_is_undone_at_more_nodes(
    distortion: tuple[float, ...], fx_px: float, least: float, most: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    lens, solved, undistort = Lens((323, 257), fx_px, 1.03 * fx_px, 150.4, 131.1, distortion), [0], cv2.undistortPoints
    monkeypatch.setattr("faintfield.calib.lens._MIN_PX", 0)  # small detectors are interpolated, too

    def counted(points: NDArray[np.float64], *arguments: Any, **options: Any) -> Any:
        solved[0] += len(points)
        return undistort(points, *arguments, **options)

    monkeypatch.setattr(cv2, "undistortPoints", counted)
    rays = lens.rays()
    assert least <= solved[0] / (323 * 257) < most
    np.testing.assert_allclose(images_of(lens, rays), pixels_of(lens), rtol=0, atol=1.2e-4)


def test_rays_take_little_extra_memory() -> None:
    lens = Lens((1500, 1000), 1600.0, 1600.0, 740.0, 510.0, (-0.1, 0.02))
    lens.rays((0, 0), (20, 20))  # what is loaded on the way is not counted
    tracemalloc.start()
    try:
        rays = lens.rays()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert rays.dtype == np.float32
    assert peak < 1.4 * rays.nbytes


@pytest.mark.parametrize(("first", "step"), [((0, 0), (4, 3)), ((5, 2), (1, 4))])
def test_lattice_is_a_slice_of_the_map(first: tuple[int, int], step: tuple[int, int]) -> None:
    lens = lens_of(DISTORTIONS[-1])
    full = lens.rays()[first[0] :: step[0], first[1] :: step[1]]
    np.testing.assert_array_equal(lens.rays(first, step), full)


@pytest.mark.parametrize(
    "distortion",
    [
        (-0.9,),  # radius 1 − 0.9 r² turns back at r = 0.61, before the corners
        (0.0, 0.0, 0.0, 0.0, 0.0, 3.0),  # 1 / (1 + 3 r²) has a largest image radius
    ],
)
def test_lens_folding_within_the_detector_is_refused(distortion: tuple[float, ...]) -> None:
    with pytest.raises(LensNotInvertible, match=r"cannot be undone over the 61 x 43 px detector"):
        lens_of(distortion).rays()


@given(seed=st.integers(0, 2**32 - 1))
def test_accepted_lens_keeps_neighbours_in_order(seed: int) -> None:
    generator = np.random.default_rng(seed)
    distortion = tuple(generator.normal(size=8) * [0.5, 0.5, 0.05, 0.05, 0.5, 0.5, 0.5, 0.5])
    try:
        rays = lens_of(distortion).rays()
    except LensNotInvertible:
        return
    right, down = np.diff(rays, axis=1)[:-1], np.diff(rays, axis=0)[:, :-1]
    assert (right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0] > 0).all()


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"fx_px": 0.0}, "focal lengths"),
        ({"cx_px": np.nan}, "finite"),
        ({"distortion": (0.0,) * 9}, "at most 8"),
        ({"size_px": (0, 43)}, "size_px"),
    ],
)
def test_invalid_lens_is_refused(changed: dict[str, Any], words: str) -> None:
    good: dict[str, Any] = {"size_px": (61, 43), "fx_px": 70.0, "fy_px": 70.0, "cx_px": 30.0, "cy_px": 21.0}
    Lens(**good)
    with pytest.raises(ValueError, match=words):
        Lens(**{**good, **changed})
