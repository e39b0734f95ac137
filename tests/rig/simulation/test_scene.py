"""The renderer, compared with closed forms, with rays cast one by one, and with the operator of `recon`."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from faintfield.calib.homography import plane_from_ray
from faintfield.calib.lens import Lens
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.rig.simulation.optics import SimulatedOptics
from faintfield.rig.simulation.scene import RenderedView, TexturedPlane, render

PINHOLE = SimulatedOptics((41, 31), 100.0, 100.0, 20.0, 15.0, vignetting=False)
AT_REFERENCE = np.zeros(6)


def card(
    name: str,
    depth_mm: float,
    *,
    reflectance: float = 1.0,
    opacity: float = 1.0,
    samples: tuple[int, int] = (25, 37),
    pitch_mm: float = 0.5,
    x_mm: float = 0.0,
    y_mm: float = 0.0,
) -> TexturedPlane:
    """A rectangle of one grey, `samples` times `pitch_mm` large."""
    grey, cover = np.full(samples, reflectance, np.float32), np.full(samples, opacity, np.float32)
    return TexturedPlane(name, grey, cover, pitch_mm, (0.0, 0.0, 0.0, x_mm, y_mm, depth_mm))


def waves(pitch_mm: float, rt_ref_plane: Sequence[float], samples: tuple[int, int] = (120, 160)) -> TexturedPlane:
    """A smooth texture: a wave along each axis, about 50 samples long."""
    rows, columns = np.indices(samples)
    reflectance = 0.5 + 0.2 * np.sin(columns / 8) + 0.2 * np.cos(rows / 7)
    opaque, pose = np.ones(samples, np.float32), tuple(float(number) for number in rt_ref_plane)
    return TexturedPlane("waves", reflectance.astype(np.float32), opaque, pitch_mm, pose)  # type: ignore[arg-type]


def view_of(
    planes: Sequence[TexturedPlane],
    optics: SimulatedOptics = PINHOLE,
    pose: NDArray[np.float64] = AT_REFERENCE,
    samples_per_px: int = 4,
) -> RenderedView:
    (view,) = render(planes, optics, pose[np.newaxis], samples_per_px=samples_per_px)
    return view


def share_between(low_px: float, high_px: float, pixels: int) -> NDArray[np.float64]:
    """Return the share of each pixel, one wide and centred on its index, that lies between two edges."""
    centres = np.arange(pixels)
    return np.asarray(np.clip(np.minimum(centres + 0.5, high_px) - np.maximum(centres - 0.5, low_px), 0.0, 1.0))


@pytest.mark.parametrize(("x_mm", "y_mm"), [(0.0, 0.0), (3.3125, -1.9375), (-36.0, 24.0)])
def test_card_covers_the_right_share_of_pixels(x_mm: float, y_mm: float) -> None:
    # 100 px focal length at 200 mm: 2 mm a pixel. Four rays per pixel and axis, one per texture sample: their sum over
    # the linear ramp at an edge is its area
    view = view_of([card("card", 200.0, reflectance=0.6, x_mm=x_mm, y_mm=y_mm)])
    half_width, half_height = 37 * 0.5 / 4, 25 * 0.5 / 4
    across = share_between(20 + x_mm / 2 - half_width, 20 + x_mm / 2 + half_width, 41)
    down = share_between(15 + y_mm / 2 - half_height, 15 + y_mm / 2 + half_height, 31)
    np.testing.assert_allclose(view.visible["card"], np.outer(down, across), atol=1e-5)
    np.testing.assert_allclose(view.light, 0.6 * np.outer(down, across), atol=1e-5)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_nearer_cards_hide_farther_ones(order: tuple[int, ...]) -> None:
    cards = [
        card("near", 200.0, reflectance=0.8, opacity=0.25),
        card("far", 400.0, reflectance=0.5, opacity=0.5),
        card("wall", 600.0, reflectance=0.3, pitch_mm=10.0),
    ]
    view = view_of([cards[k] for k in order])
    assert [view.visible[name][15, 20] for name in ("near", "far", "wall")] == pytest.approx([0.25, 0.375, 0.375])
    assert view.light[15, 20] == pytest.approx(0.25 * 0.8 + 0.375 * 0.5 + 0.375 * 0.3)
    assert view.light[15, 5] == pytest.approx(0.3)
    from_500_mm_looking_back = np.array([0.0, np.pi, 0.0, 0.0, 0.0, 500.0])
    light = view_of([cards[k] for k in order], pose=from_500_mm_looking_back).light
    assert light[15, 20] == pytest.approx(0.5 * 0.5 + 0.5 * 0.25 * 0.8)


@pytest.mark.parametrize("depth_mm", [-200.0, 0.0])
def test_card_not_in_front_is_not_seen(depth_mm: float) -> None:
    view = view_of([card("behind", depth_mm)])
    assert not view.light.any()
    assert not view.visible["behind"].any()


def test_tilted_plane_is_met_by_single_rays() -> None:
    plane = waves(1.3, (0.5, -0.4, 0.3, 8.0, -6.0, 220.0))
    pose = np.array([0.05, -0.08, 0.1, 12.0, -9.0, 15.0])
    optics = replace(PINHOLE, distortion=(-0.1, 0.02, 1e-3, -1e-3))
    light, rays = view_of([plane], optics, pose, samples_per_px=1).light, optics.rays()
    r_cam_ref, r_ref_plane = Rotation.from_rotvec(pose[:3]), Rotation.from_rotvec(plane.rt_ref_plane[:3])
    camera, origin = -r_cam_ref.inv().apply(pose[3:]), np.array(plane.rt_ref_plane[3:])
    axis_x, axis_y, normal = r_ref_plane.as_matrix().T
    met, steepness = [], []
    for row, column in np.ndindex(light.shape):
        direction = r_cam_ref.inv().apply([*rays[row, column], 1.0])
        point = camera + direction * (normal @ (origin - camera)) / (normal @ direction) - origin
        along = axis_y @ point / 1.3 + 119 / 2, axis_x @ point / 1.3 + 159 / 2
        tents = [np.maximum(0, 1 - np.abs(np.arange(size) - at)) for size, at in zip((120, 160), along, strict=True)]
        met.append(tents[0] @ plane.reflectance @ tents[1])
        at_edge = any(-1 < at < 1 or -2 < at - size < 0 for size, at in zip((120, 160), along, strict=True))
        steepness.append(1.0 if at_edge else 0.2 / 7 + 0.2 / 8)
    # The renderer's look-up rounds to 1/32 of a texture sample
    assert (np.abs(light.ravel() - met) <= np.array(steepness) / 64 + 1e-4).all()
    assert np.ptp(met) > 0.5


def test_colours_are_independent_and_grey_their_mean() -> None:
    plane = waves(1.3, (0.1, 0.2, 0, 0, 0, 220.0))
    colour = np.stack([plane.reflectance, 0.5 * plane.reflectance, 1 - plane.reflectance], axis=-1)
    planes = [replace(plane, reflectance=colour), replace(card("card", 100.0), reflectance=np.full((25, 37, 3), 0.4))]
    light = view_of(planes).light
    for channel in range(3):
        alone = view_of([replace(plane, reflectance=plane.reflectance[..., channel]) for plane in planes]).light
        np.testing.assert_allclose(light[..., channel], alone, atol=1e-3)
    np.testing.assert_allclose(view_of([plane.grey() for plane in planes]).light, light.mean(axis=2), atol=1e-3)


@pytest.mark.parametrize(("samples_per_px", "distortion"), [(1, (-0.1, 0.02, 1e-3, -1e-3)), (3, ())])
def test_renderer_agrees_with_the_operator(distortion: tuple[float, ...], samples_per_px: int) -> None:
    plane = waves(2.0, (0.2, -0.15, 0.1, 5.0, -4.0, 300.0))
    optics = SimulatedOptics((41, 31), 50.0, 50.0, 19.3, 15.8, distortion)
    lens = Lens((41, 31), 50.0, 50.0, 19.3, 15.8, distortion)
    poses = np.array([[0.0, 0, 0, 0, 0, 0], [0.03, -0.05, 0.1, 30, -25, 8], [-0.05, 0.04, 0, -35, 20, -12]])
    grid = PlaneGrid((120, 160), 2.0, (-159.0, -119.0))
    operator = PlaneOperator(
        plane_from_ray(poses, np.array(plane.rt_ref_plane)), lens.rays(), grid, flat=optics.relative_illumination()
    )
    forward, inside = operator.forward(plane.reflectance), operator.forward(np.ones(grid.shape)) > 0
    for view, rendered in enumerate(render([plane], optics, poses, samples_per_px=samples_per_px)):
        whole = inside[view] & (rendered.visible["waves"] > 1 - 1e-6)
        assert whole.sum() > 0.6 * whole.size
        # With several rays the renderer averages over a pixel of 6 mm, the operator sees its centre
        tolerance = 1e-3 if samples_per_px == 1 else 0.005
        np.testing.assert_allclose(rendered.light[whole], forward[view][whole], atol=tolerance)
