"""The lens, the assumed errors and the error of all depths of an alignment."""

from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from faintfield.calib.lens import Lens
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.alignment import change_lens, distance_of_neighbours, inverse_depth_sigma


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.05), (-0.2, 0.05, 1e-3, -5e-4, 0.01, 0.1, -0.02, 0.0)])
def test_changed_lens_is_the_old_one_after_the_change(distortion: tuple[float, ...]) -> None:
    old, change = Lens((640, 480), 900.0, 910.0, 320.0, 240.0, distortion), (0.02, 0.01)
    rays = np.random.default_rng(1).uniform(-0.25, 0.25, (50, 2))
    turned = (1 + change[0]) * (1 + change[1] * np.sum(rays**2, axis=1, keepdims=True)) * rays
    ones = np.ones((50, 1))
    wanted = old.project(np.hstack([turned, ones]))
    np.testing.assert_allclose(change_lens(old, change).project(np.hstack([rays, ones])), wanted, atol=0.05)


def test_cameras_at_one_place_are_no_neighbours(simulated_scene: Path) -> None:
    elemental_set = load_set(simulated_scene)
    first, *rest = elemental_set.settings.view
    twice = [first, first, *rest, *rest]
    settings = msgspec.structs.replace(elemental_set.settings, view=twice)
    apart = distance_of_neighbours(replace(elemental_set, settings=settings))
    assert apart == pytest.approx(distance_of_neighbours(elemental_set))


def test_error_of_all_depths_is_that_of_a_fit_to_wrong_poses() -> None:
    places_mm = 10.0 * np.array([(x, y) for y in range(-2, 3) for x in range(-2, 3)])
    rng, depth_mm = np.random.default_rng(2), 700.0
    poses = np.zeros((25, 6))
    poses[:, 3:5] = -places_mm
    sigma = np.tile([3e-3, 3e-3, 3e-3, 0.1, 0.1, 0.1], 25)

    def seen(poses: NDArray[np.float64], inverse_depth: float) -> NDArray[np.float64]:
        point = np.array([[0.0, 0.0, 1 / inverse_depth]])
        return np.array([cv2.projectPoints(point, pose[:3], pose[3:], np.eye(3), None)[0].ravel() for pose in poses])

    def error(taken: NDArray[np.float64]) -> float:
        """Return by how much 1/depth is wrong if these poses are taken for the true ones."""
        wanted = seen(poses, 1 / depth_mm)
        fit = minimize_scalar(lambda q: np.sum((seen(taken, q) - wanted) ** 2), bounds=(1e-4, 4e-3), method="bounded")
        return float(fit.x) - 1 / depth_mm

    errors = [error(poses + sigma.reshape(25, 6) * rng.normal(size=(25, 6))) for _ in range(200)]
    found = inverse_depth_sigma(poses, poses, np.diag(sigma**2), depth_mm, depths_known=True)
    assert found == pytest.approx(np.std(errors), rel=0.15)
    grown = poses.copy()
    grown[:, 0], grown[:, 1] = 2e-4 * places_mm[:, 1], -2e-4 * places_mm[:, 0]
    exact = np.zeros((150, 150))
    changed = inverse_depth_sigma(poses, grown, exact, depth_mm, depths_known=False)
    assert changed == pytest.approx(abs(error(grown)), rel=0.02)
    assert changed == pytest.approx(2e-4, rel=0.02)
    assert inverse_depth_sigma(poses, grown, exact, depth_mm, depths_known=True) < 1e-9
