"""`reconstruct --prior`: the files and records it promises, what it refuses, and errors below those without it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from faintfield.pipelines.cli import run
from faintfield.pipelines.reconstruction import prior as prior_module
from tests.pipelines.conftest import Command, drawing_nothing
from tests.pipelines.forms import read_record

pytestmark = pytest.mark.usefixtures("undrawn")


PATCHES = ("--prior", "patches")
NEAR = ("--depth-mm", 500)
BOTH = (*NEAR, "--depth-mm", 700)
QUICK = ("--passes", 2, "--penalty-weight", 2)


def _planes(folder: Path) -> list[dict[str, Any]]:
    return list(read_record(folder)["planes"])


def _run(*words: object) -> None:
    with drawing_nothing():
        assert run([str(word) for word in words]) == 0


def _files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("plane_*")}


@pytest.fixture(scope="module")
def dark_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """5 x 5 views of 128 x 96 px at the darkness of the paper, to be read only."""
    folder = tmp_path_factory.mktemp("dark") / "scene"
    _run("simulate", folder, "--size-px", 128, 96, "--rows", 5, "--columns", 5, "--snr", 0.16)
    return folder


@pytest.fixture(scope="module")
def proposed(dark_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plane of the dark set by patches, with what was proposed, to be read only."""
    out = tmp_path_factory.mktemp("proposed") / "out"
    _run("reconstruct", dark_set, *NEAR, *PATCHES, "--proposal", "--uncertainty", "--out", out)
    return out


@pytest.fixture(scope="module")
def without(dark_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same plane by total variation alone, to be read only."""
    out = tmp_path_factory.mktemp("without") / "out"
    _run("reconstruct", dark_set, *NEAR, "--prior", "tv", "--uncertainty", "--out", out)
    return out


def test_proposal_and_change_are_written_beside_plane(proposed: Path) -> None:
    (plane,) = _planes(proposed)
    assert plane["proposal_file"] == "plane_00500.0_proposal.tiff"
    assert plane["moved_file"] == "plane_00500.0_moved.tiff"
    light, x, moved = (tifffile.imread(proposed / plane[key]) for key in ("file", "proposal_file", "moved_file"))
    assert light.dtype == x.dtype == moved.dtype == np.float32
    assert min(light.min(), x.min()) >= 0
    # Moved is the difference in positive units of noise
    assert ((light - x) * moved >= 0).all()
    other = moved != 0  # dark samples are exactly black in both
    sigma = (light - x)[other] / moved[other]
    assert other.mean() > 0.5
    assert 0.1 < np.percentile(sigma, 1) < np.percentile(sigma, 99) < 10
    assert plane["prior"]["moved_sigma"] == pytest.approx(np.sqrt(np.mean(np.square(moved))), rel=0.02)
    assert 0 < plane["prior"]["moved_sigma"] < 1


def test_record_has_mixtures_and_certificate(proposed: Path, without: Path) -> None:
    (plane,), (first,) = _planes(proposed), _planes(without)
    assert plane["prior"]["name"] == "patches"
    mixture = plane["prior"]["mixture"]
    assert set(mixture) == {"light, detail", "light, smooth", "dark, detail", "dark, smooth"}
    for weights in mixture.values():
        assert list(weights) == ["tv", "wiener", "twice", "fine"]
        assert min(weights.values()) >= 0
        assert sum(weights.values()) == pytest.approx(1, abs=1e-9)
    assert plane["certificate"]["reached"]
    assert plane["certificate"]["passes"] == plane["passes"]
    for key in ("penalty_weight", "penalty_weight_chosen", "penalty_weight_curve", "penalty", "likelihood"):
        assert plane[key] == first[key]
    assert plane["passes_before"] == pytest.approx(first["passes_before"] + first["passes"])
    assert plane["mean_e"] == pytest.approx(tifffile.imread(proposed / plane["file"]).mean(dtype=float), rel=1e-6)
    options = read_record(proposed)["options"]
    assert (options["prior"], options["proposal"]) == ("patches", True)


def test_prior_lowers_error_at_darkness_of_paper(proposed: Path, without: Path) -> None:
    errors = []
    for folder in (proposed, without):
        (row,) = json.loads((folder / "metrics.json").read_text())["planes"]
        errors.append((row["mse_bright"], row["mse_texture"]))
    assert np.all(np.less(errors[0], np.multiply(0.95, errors[1])))


@pytest.mark.parametrize(
    ("words", "prior"),
    [
        (NEAR, "auto"),
        ((*NEAR, "--method", "mlem"), None),
        (("--sweep-mm", "480:520:2"), None),
    ],
)
def test_prior_is_auto_by_default(
    words: tuple[object, ...], prior: str | None, scene: Path, tmp_path: Path, done: Command
) -> None:
    done("reconstruct", scene, *words, *QUICK, "--out", tmp_path / "out")
    found = [json.loads(path.read_text()) for path in (tmp_path / "out").glob("**/reconstruction.json")]
    assert found
    for record in found:
        expected = None if record["options"]["method"] == "backprojection" else prior
        assert record["options"].get("prior") == expected


def test_total_variation_stays_where_no_candidate_is_better(
    dark_set: Path, without: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prior_module, "patch_candidates", lambda evidence: {"tv": evidence.pilot})
    _run("reconstruct", dark_set, *NEAR, *PATCHES, "--out", tmp_path)
    (plane,) = _planes(tmp_path)
    assert plane["prior"] == {"name": "tv", "left_out": "total variation predicts held-out views best"}
    assert (tmp_path / plane["file"]).read_bytes() == (without / plane["file"]).read_bytes()


def _coverage_and_width(dark_set: Path, folder: Path) -> tuple[float, float]:
    """Return how much of the near object 90 % intervals hold, and the root mean square of its standard deviation."""
    truth = tifffile.imread(dark_set / "truth" / "plane_00500.0.tiff")
    plane, sigma = (tifffile.imread(folder / f"plane_00500.0{end}.tiff")[truth > 0] for end in ("", "_sigma"))
    coverage = np.mean(np.abs(plane - truth[truth > 0]) <= 1.645 * sigma)
    return float(coverage), float(np.sqrt(np.mean(np.square(sigma, dtype=float))))


def test_standard_deviation_covers_truth(dark_set: Path, proposed: Path, without: Path) -> None:
    for folder in (proposed, without):
        assert _coverage_and_width(dark_set, folder)[0] > 0.7  # few views of few pixels


@pytest.mark.deep
def test_standard_deviation_of_joint_planes_is_about_proposal(dark_set: Path, tmp_path: Path, done: Command) -> None:
    answers = []
    for prior in ("patches", "tv"):
        words = (*BOTH, "--joint", "--uncertainty", "--prior", prior)
        done("reconstruct", dark_set, *words, "--out", tmp_path / prior)
        answers.append(_coverage_and_width(dark_set, tmp_path / prior))
    assert min(coverage for coverage, _ in answers) > 0.7  # one object hides a part of the other
    assert answers[0][1] < answers[1][1]


def test_planes_found_together_have_proposal_and_certificate_each(scene: Path, tmp_path: Path, done: Command) -> None:
    words = ("--joint", "--occlusion", *PATCHES, "--proposal", "--penalty-weight", 2)
    done("reconstruct", scene, *BOTH, *words, "--out", tmp_path)
    for method in ("joint", "occlusion"):
        planes = _planes(tmp_path / method)
        assert len(planes) == 2
        assert planes[0]["prior"]["mixture"] != planes[1]["prior"]["mixture"]
        for plane in planes:
            assert plane["prior"]["name"] == "patches"
            assert plane["certificate"]["reached"]
            assert np.isfinite(plane["prior"]["moved_sigma"])
            assert np.isfinite(tifffile.imread(tmp_path / method / plane["moved_file"])).all()


def test_only_planes_of_another_prior_are_made_again(scene: Path, tmp_path: Path, done: Command) -> None:
    words = ("reconstruct", scene, *NEAR, *QUICK, "--out", tmp_path)
    done(*words, *PATCHES)
    by_patches = _files(tmp_path)
    assert "1 of 1 planes are there" in done(*words, *PATCHES).stderr
    assert "are there" not in done(*words, *PATCHES, "--proposal").stderr
    assert set(_files(tmp_path)) == {*by_patches, "plane_00500.0_proposal.tiff", "plane_00500.0_moved.tiff"}
    assert "are there" not in done(*words, "--prior", "tv").stderr
    by_variation = _files(tmp_path)
    assert set(by_variation) == set(by_patches)
    assert by_variation["plane_00500.0.tiff"] != by_patches["plane_00500.0.tiff"]


def test_too_few_views_give_plane_of_total_variation(tmp_path: Path, done: Command) -> None:
    done("simulate", tmp_path / "set", "--size-px", 64, 48, "--rows", 1, "--columns", 3)
    for name, words in (("tv", ()), ("patches", (*PATCHES, "--proposal"))):
        done("reconstruct", tmp_path / "set", *NEAR, *words, "--out", tmp_path / name)
    (plane,), (first,) = _planes(tmp_path / "patches"), _planes(tmp_path / "tv")
    assert plane["prior"] == {"name": "tv", "left_out": "too few views to hold some out"}
    assert not {"proposal_file", "moved_file"} & set(plane)
    assert (tmp_path / "patches" / plane["file"]).read_bytes() == (tmp_path / "tv" / first["file"]).read_bytes()
    again = done("reconstruct", tmp_path / "set", *NEAR, *PATCHES, "--proposal", "--out", tmp_path / "patches")
    assert "1 of 1 planes are there" in again.stderr
