"""Planes that no two views see are refused, with the depths that the views share."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.depth.shared_range import is_shared, shared_range_mm
from tests.pipelines.conftest import Command, Edit


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--depth-mm", 0.5), ("plane at 0.5 mm", "did you mean 500 mm?")),
        (("--depth-mm", 0.01), ("plane at 0.01 mm", "from 67.7 mm on; give such")),
        (("--sweep-mm", "0.4:0.9:4"), ("4 of 4 planes at 0.4 to 0.9 mm", "did you mean 400 to 900 mm?")),
        (("--sweep-mm", "1:900:4"), ("plane at 1 mm", "give such")),
        (("--depth-mm", "auto", "--sweep-mm", "0.4:0.9:4"), ("between 0.4 and 0.9 mm", "did you mean 400 to 900 mm?")),
        (("--surface", "--depth-range-mm", "0.4:0.9"), ("between 0.4 and 0.9 mm", "did you mean 400 to 900 mm?")),
        (("--disparity-px", -4000), ("plane at ", "give such")),
    ],
)
def test_planes_that_no_two_views_see_are_refused(
    words: tuple[object, ...], expected: tuple[str, ...], simulated_scene: Path, tmp_path: Path, faintfield: Command
) -> None:
    ended = faintfield("reconstruct", simulated_scene, "--out", tmp_path / "out", *words)
    assert ended.returncode == 1
    assert "GeometryMismatch" in ended.stderr
    assert all(word in ended.stderr for word in expected), ended.stderr
    assert not list(tmp_path.glob("out/plane*"))


def test_shared_range_ends_where_inward_cameras_part(scene: Path, edit: Edit) -> None:
    def turn_inwards(settings: dict[str, Any]) -> None:
        for view in settings["view"]:
            x_mm, y_mm = view["rt_cam_ref"][3:5]
            turned = [float(np.arctan(y_mm / 40.0)), -float(np.arctan(x_mm / 40.0)), 0.0]
            view["rt_cam_ref"] = [*turned, x_mm, y_mm, 0.0]

    outward = shared_range_mm(load_set(scene))
    assert outward is not None
    assert outward[1] == np.inf
    inward_set = load_set(edit(scene, turn_inwards))
    inward = shared_range_mm(inward_set)
    assert inward is not None
    assert inward[0] < inward[1] < np.inf
    for depth, shared in ((inward[1], True), (1.02 * inward[1], False), (0.98 * inward[0], False)):
        assert is_shared(inward_set, depth) == shared
