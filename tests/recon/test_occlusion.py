"""Opacity from light, and the transmission of farther planes, on simple scenes with known answers."""

import numpy as np
import pytest

from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import Occluders, opacity
from faintfield.recon.operator.scene_operator import SceneOperator


def test_bright_objects_are_opaque_and_faint_ghosts_are_not() -> None:
    generator = np.random.default_rng(2)
    plane = np.maximum(generator.normal(0, 0.1, (60, 80)), 0)
    plane[20:40, 20:50] += 1.0
    plane[20:40, 60:76] += 0.05
    found = opacity(plane)
    assert found[25:35, 25:45].min() > 0.99
    assert found[:12].max() < 0.05
    assert found[25:35, 64:72].max() < 0.1
    assert 0 <= found.min() <= found.max() <= 1


def test_a_plane_without_light_hides_nothing() -> None:
    np.testing.assert_array_equal(opacity(np.zeros((5, 6))), 0)


def test_each_plane_is_hidden_by_all_nearer_planes_and_no_other() -> None:
    homographies = np.stack([np.eye(3)] * 6).reshape(3, 2, 3, 3)
    homographies[:, 1, 0, 2] = 1.0  # the second view is displaced by one sample
    rays = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0)), axis=-1)
    grids = [PlaneGrid((5, 9), 1.0, (0.0, 0.0))] * 3
    flat = np.full((5, 7), 0.5)
    opacities = [np.zeros((5, 9)) for _ in grids]
    opacities[0][2, 4], opacities[1][2, 4], opacities[2][1, 1] = 0.5, 1.0, 1.0

    def transmission() -> list[Image]:
        hiding = Occluders(opacities, [600.0, 500.0, 900.0])
        operator = SceneOperator(homographies, rays, grids, flat=flat, occluders=hiding, dtype=np.float64, workers=1)
        return [operator.forward(one) / flat for one in np.repeat(np.eye(3), 5 * 9, axis=1)]

    expected = np.ones((3, 2, 5, 7))
    expected[0, 0, 2, 4] = expected[0, 1, 2, 3] = 0.0  # by the plane at 500 mm alone
    expected[2, 0, 2, 4] = expected[2, 1, 2, 3] = 0.0  # by both
    np.testing.assert_allclose(transmission(), expected, atol=1e-12)
    opacities[1][2, 4] = 0.4
    assert transmission()[2][0, 2, 4] == pytest.approx(0.3)
