"""Planes found together: nearer the truth than each alone, and as files no different from other planes."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from tests.pipelines.conftest import Command, assert_refused
from tests.pipelines.forms import read_record

BOTH = ("--depth-mm", 500, "--depth-mm", 700, "--prior", "tv")


def test_joint_and_occlusion_lower_the_error(bright_scene: Path, tmp_path: Path, done: Command) -> None:
    out = tmp_path / "out"
    done("reconstruct", bright_scene, *BOTH, "--method", "pmlem", "--joint", "--occlusion", "--out", out)
    errors = dict.fromkeys(("pmlem", "joint", "occlusion"), 0.0)
    for row in read_record(out, "metrics.json")["planes"]:
        errors[row["method"]] += row["mse_plane"]
    assert errors["joint"] < 0.5 * errors["pmlem"]
    assert errors["occlusion"] < 0.8 * errors["joint"]
    together = read_record(out / "occlusion")["planes"]
    (joint, _) = read_record(out / "joint")["planes"]
    assert together[0]["passes"] < joint["passes"], "it starts from the planes of joint"
    assert [plane["occlusion"] for plane in together] == [True, True]
    opacity = tifffile.imread(out / "occlusion" / together[0]["opacity_file"])
    texture = tifffile.imread(bright_scene / "truth" / "plane_00500.0.tiff")
    assert 0 <= opacity.min() <= opacity.max() <= 1
    assert np.mean((opacity > 0.5) == (texture > 0)) > 0.95


def test_occlusion_keeps_penalty_and_lowers_objective(scene: Path, tmp_path: Path, done: Command) -> None:
    options = ("--penalty", "huber-tv", "--likelihood", "least-squares", "--penalty-weight", 1)
    done("reconstruct", scene, *BOTH, *options, "--joint", "--occlusion", "--out", tmp_path)
    joint, occlusion = (read_record(tmp_path / name)["planes"][0] for name in ("joint", "occlusion"))
    assert joint["penalty"] == occlusion["penalty"]  # its δ follows the noise, which another start would shift
    assert occlusion["objective"] <= joint["objective"]
    assert occlusion["occlusion"] != ("occlusion_left_out" in occlusion)


def test_what_memory_has_no_room_for_is_refused(
    scene: Path, tmp_path: Path, faintfield: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("faintfield.pipelines.reconstruction.planes.solve.available_bytes", lambda: 100_000)
    ended = faintfield("reconstruct", scene, *BOTH, "--occlusion", "--out", tmp_path / "out")
    assert_refused(ended, "MemoryShort", "planes found together need")
