"""The lens and the assumed errors of an alignment."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from faintfield.calib.lens import Lens
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.alignment import change_lens, distance_of_neighbours


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
