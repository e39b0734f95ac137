"""`reconstruct --surface --prior`: the files and records it promises, what it refuses, and its errors."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.reconstruction import prior as prior_module
from faintfield.pipelines.reconstruction import surface
from tests.pipelines.conftest import Command, Edit
from tests.pipelines.forms import read_record
from tests.pipelines.surfaces import FOUND_MM, Searches

pytestmark = pytest.mark.usefixtures("undrawn")


RANGE = ("--depth-range-mm", "400:900")
FAST = ("--surface", *RANGE, "--penalty-weight", 0.5, "--passes", 4)
PROPOSED = {f"picture_{name}{suffix}" for name in ("proposal", "moved") for suffix in (".tiff", ".png")}


def _map(folder: Path, name: str = "picture") -> NDArray[np.float32]:
    return np.asarray(tifffile.imread(folder / f"{name}.tiff"))


def test_default_picture_is_total_variation_with_detail(
    seen: Searches, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: Command
) -> None:
    monkeypatch.setattr(surface, "refined", lambda operator, images, plane: plane + np.float32(1))
    done("reconstruct", scene, *FAST, "--out", tmp_path / "default")
    done("reconstruct", scene, *FAST, "--prior", "tv", "--out", tmp_path / "tv")
    np.testing.assert_array_equal(_map(tmp_path / "default"), _map(tmp_path / "tv") + np.float32(1))
    default, tv = read_record(tmp_path / "default", "surface.json"), read_record(tmp_path / "tv", "surface.json")
    assert tv["options"] == default["options"] | {"prior": "tv"}
    assert not {"prior", "proposal"} & {*default["options"], *default["surface"]["channels"][0]}
    assert set(default["sha256"]) == set(tv["sha256"])


def test_surface_at_one_depth_equals_the_plane(seen: Searches, scene: Path, tmp_path: Path, done: Command) -> None:
    weight = ("--penalty-weight", 0.5)
    done("reconstruct", scene, "--surface", *RANGE, *weight, "--prior", "tv", "--out", tmp_path / "surface")
    done("reconstruct", scene, "--depth-mm", FOUND_MM, *weight, "--prior", "tv", "--out", tmp_path / "plane")
    found, plane = _map(tmp_path / "surface"), _map(tmp_path / "plane", f"plane_{FOUND_MM:07.1f}")
    (channel,) = read_record(tmp_path / "surface", "surface.json")["surface"]["channels"]
    assert channel["certificate"]["reached"]
    # Both are certified to 1 % of the same optimum
    assert np.linalg.norm(found - plane) < 0.02 * np.linalg.norm(plane)


def test_proposal_and_change_are_written_beside_picture(
    seen: Searches, scene: Path, tmp_path: Path, done: Command
) -> None:
    call = ("reconstruct", scene, *FAST, "--prior", "patches")
    done(*call, "--proposal", "--out", tmp_path / "out")
    picture, proposal, moved = (_map(tmp_path / "out", f"picture{name}") for name in ("", "_proposal", "_moved"))
    assert picture.shape == proposal.shape == moved.shape
    assert picture.dtype == proposal.dtype == moved.dtype == np.float32
    assert min(picture.min(), proposal.min()) >= 0
    assert ((picture - proposal) * moved >= 0).all()
    record = read_record(tmp_path / "out", "surface.json")
    (channel,) = record["surface"]["channels"]
    assert channel["prior"]["name"] == "patches"
    for weights in channel["prior"]["mixture"].values():
        assert sum(weights.values()) == pytest.approx(1)
    assert channel["prior"]["moved_sigma"] == pytest.approx(np.sqrt(np.mean(np.square(moved))), rel=0.02)
    assert channel["mean_e"] == pytest.approx(picture.mean(dtype=float), rel=1e-6)
    assert (record["options"]["prior"], record["options"]["proposal"]) == ("patches", True)
    assert set(record["sha256"]) >= PROPOSED
    done("verify", tmp_path / "out", "--inputs", scene)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "patches; the data moved it by" in page
    assert "What the prior proposed" in page
    done(*call, "--out", tmp_path / "out")
    assert not PROPOSED & {path.name for path in (tmp_path / "out").iterdir()}, "files of the earlier surface"
    np.testing.assert_array_equal(_map(tmp_path / "out"), picture)
    done("verify", tmp_path / "out")


def test_each_colour_has_prior_of_its_own(
    seen: Searches, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: Command
) -> None:
    monkeypatch.setattr(prior_module, "patch_candidates", lambda evidence: {"pilot": evidence.pilot})
    for path in scene.glob("view_*.tiff"):
        grey = read_frame(path).pixels_dn
        write_frame(path, np.stack([grey, grey // 2 + 50, grey], axis=-1))
    done("reconstruct", scene, *FAST, "--prior", "patches", "--proposal", "--out", tmp_path)
    red, green, blue = (channel["prior"] for channel in read_record(tmp_path, "surface.json")["surface"]["channels"])
    assert red == blue != green
    assert _map(tmp_path, "picture_moved").shape == _map(tmp_path).shape == (72, 96, 3)


def test_too_few_views_give_picture_of_total_variation(
    seen: Searches, scene: Path, edit: Edit, tmp_path: Path, done: Command
) -> None:
    def four_views(settings: dict[str, Any]) -> None:
        settings.update(view=[settings["view"][index] for index in (4, 1, 3, 5)], reference_view=0)
        settings["view"][1].update(rt_cam_ref=[0.0, 3.0, 0.0, 50.0, 50.0, 0.0])  # sees nothing

    edit(scene, four_views)
    done("reconstruct", scene, *FAST, "--prior", "tv", "--out", tmp_path / "tv")
    done("reconstruct", scene, *FAST, "--prior", "patches", "--proposal", "--out", tmp_path / "patches")
    (channel,) = read_record(tmp_path / "patches", "surface.json")["surface"]["channels"]
    assert channel["prior"] == {"name": "tv", "left_out": "too few views to hold some out"}
    assert not PROPOSED & {path.name for path in (tmp_path / "patches").iterdir()}
    np.testing.assert_array_equal(_map(tmp_path / "patches"), _map(tmp_path / "tv"))
    assert "tv: too few views to hold some out" in (tmp_path / "patches" / "report.html").read_text()


def _error(folder: Path, truth: Path) -> float:
    """Return the mean squared error of a picture against the light that the simulator rendered."""
    return float(np.mean(np.square(_map(folder) - tifffile.imread(truth / "truth" / "true_picture.tiff"))))


@pytest.mark.deep
@pytest.mark.parametrize("snr", [0.16, 1])
def test_on_depths_that_are_found_prior_lowers_error(snr: float, tmp_path: Path) -> None:
    small = ("--size-px", 160, 120, "--rows", 5, "--columns", 5, "--snr", snr)
    assert run([str(word) for word in ("simulate", tmp_path / "set", "--objects", "surfaces", *small)]) == 0
    errors = {}
    for prior in ("tv", "auto"):
        words = ("reconstruct", tmp_path / "set", "--surface", "--depth-range-mm", "450:1200", "--prior", prior)
        assert run([str(word) for word in (*words, "--out", tmp_path / prior)]) == 0
        errors[prior] = _error(tmp_path / prior, tmp_path / "set")
    assert errors["auto"] < 0.94 * errors["tv"]
