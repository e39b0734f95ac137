"""`reconstruct --prior`: its files and records, errors below those without it, and the light of other colours."""

import weakref
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.formats.frames import ChannelLayout
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.pipelines.reconstruction.planes import prior as prior_module
from faintfield.pipelines.reconstruction.planes import sweep
from faintfield.pipelines.reconstruction.planes.penalised import Objective, solve_pmlem
from faintfield.pipelines.reconstruction.planes.prior import with_prior
from faintfield.pipelines.reconstruction.planes.solve import solve, solve_together
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.prior.collaborative import patch_candidates
from faintfield.recon.prior.evidence import Evidence
from faintfield.recon.solver.data_fit import SceneProblem
from tests.pipelines.conftest import Command, run_undrawn
from tests.pipelines.forms import check_proposal, plane_files, read_record

PATCHES = ("--prior", "patches")
NEAR = ("--depth-mm", 500)
BOTH = (*NEAR, "--depth-mm", 700)
QUICK = ("--passes", 2, "--penalty-weight", 2)


@pytest.fixture(scope="module")
def proposed(dark_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plane of the dark set by patches, with what was proposed, to be read only."""
    out = tmp_path_factory.mktemp("proposed") / "out"
    run_undrawn("reconstruct", dark_scene, *NEAR, *PATCHES, "--proposal", "--uncertainty", "--out", out)
    return out


@pytest.fixture(scope="module")
def without(dark_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same plane by total variation alone, to be read only."""
    out = tmp_path_factory.mktemp("without") / "out"
    run_undrawn("reconstruct", dark_scene, *NEAR, "--prior", "tv", "--uncertainty", "--out", out)
    return out


def test_data_move_plane_from_proposal_where_penalty_is_weak(dark_scene: Path, tmp_path: Path) -> None:
    run_undrawn(
        "reconstruct", dark_scene, *NEAR, *PATCHES, "--penalty-weight", 0.2, "--proposal", "--out", tmp_path / "out"
    )
    (plane,) = read_record(tmp_path / "out")["planes"]
    light, x, moved = (
        tifffile.imread(tmp_path / "out" / plane[key]) for key in ("file", "proposal_file", "moved_file")
    )
    check_proposal(light, x, moved, plane["prior"]["moved_sigma"])
    other = moved != 0  # dark samples are exactly black in both
    sigma = (light - x)[other] / moved[other]
    assert other.mean() > 0.5
    assert 0.1 < np.percentile(sigma, 1) < np.percentile(sigma, 99) < 10
    assert 0.1 < plane["prior"]["moved_sigma"] < 1


def test_plane_has_proposal_change_mixtures_and_certificate(proposed: Path, without: Path) -> None:
    (plane,) = read_record(proposed)["planes"]
    assert plane["proposal_file"] == "plane_00500.0_proposal.tiff"
    assert plane["moved_file"] == "plane_00500.0_moved.tiff"
    light, x, moved = (tifffile.imread(proposed / plane[key]) for key in ("file", "proposal_file", "moved_file"))
    check_proposal(light, x, moved, plane["prior"]["moved_sigma"])
    assert 0 <= plane["prior"]["moved_sigma"] < 0.1
    (first,) = read_record(without)["planes"]
    assert plane["penalty_weight"] == first["penalty_weight"]
    assert plane["prior"]["penalty_weight"] == pytest.approx(1.2 * first["penalty_weight"])
    assert plane["prior"]["name"] == "patches"
    mixture = plane["prior"]["mixture"]
    assert set(mixture) == {"light, detail", "light, smooth", "dark, detail", "dark, smooth"}
    for weights in mixture.values():
        assert list(weights) == ["tv", "wiener", "twice", "half wiener", "half twice"]
        assert min(weights.values()) >= 0
        assert sum(weights.values()) == pytest.approx(1, abs=1e-9)
    assert plane["certificate"]["reached"]
    assert plane["certificate"]["passes"] == plane["passes"]
    for key in ("penalty_weight", "penalty_weight_chosen", "penalty_weight_curve", "penalty", "likelihood"):
        assert plane[key] == first[key]
    assert 0 < plane["passes_before"] - first["passes_before"] <= first["passes"]  # a pilot's certificate is wider
    assert plane["mean_e"] == pytest.approx(tifffile.imread(proposed / plane["file"]).mean(dtype=float), rel=1e-6)
    options = read_record(proposed)["options"]
    assert (options["prior"], options["proposal"]) == ("patches", True)


def _coverage_and_width(scene: Path, folder: Path) -> tuple[float, float]:
    """Return how much of the near object 90 % intervals hold, and the root mean square of its standard deviation."""
    truth = tifffile.imread(scene / "truth" / "plane_00500.0.tiff")
    plane, sigma = (tifffile.imread(folder / f"plane_00500.0{end}.tiff")[truth > 0] for end in ("", "_sigma"))
    coverage = np.mean(np.abs(plane - truth[truth > 0]) <= 1.645 * sigma)
    return float(coverage), float(np.sqrt(np.mean(np.square(sigma, dtype=float))))


def test_prior_lowers_error_and_covers_truth(dark_scene: Path, proposed: Path, without: Path) -> None:
    errors = []
    for folder in (proposed, without):
        (row,) = read_record(folder, "metrics.json")["planes"]
        errors.append((row["mse_bright"], row["mse_texture"]))
    assert np.all(np.less(errors[0], np.multiply(0.95, errors[1])))
    assert min(_coverage_and_width(dark_scene, folder)[0] for folder in (proposed, without)) > 0.7  # few small views


def test_total_variation_stays_where_no_candidate_is_better(
    dark_scene: Path, without: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prior_module, "patch_candidates", lambda evidence, names=None: {"tv": evidence.pilot})
    run_undrawn("reconstruct", dark_scene, *NEAR, *PATCHES, "--proposal", "--out", tmp_path)
    (plane,) = read_record(tmp_path)["planes"]
    assert plane["prior"] == {"name": "tv", "left_out": "total variation predicts held-out views best"}
    assert not {"proposal_file", "moved_file"} & set(plane)
    assert (tmp_path / plane["file"]).read_bytes() == (without / plane["file"]).read_bytes()


@pytest.mark.deep
def test_standard_deviation_of_joint_planes_is_about_proposal(tmp_path: Path, done: Command) -> None:
    scene = tmp_path / "scene"
    done("simulate", scene, "--size-px", 128, 96, "--rows", 5, "--columns", 5)
    answers = []
    for prior in ("patches", "tv"):
        words = (*BOTH, "--joint", "--uncertainty", "--prior", prior)
        done("reconstruct", scene, *words, "--out", tmp_path / prior)
        answers.append(_coverage_and_width(scene, tmp_path / prior))
    assert min(coverage for coverage, _ in answers) > 0.7  # one object hides a part of the other
    assert answers[0][1] < answers[1][1]


@pytest.mark.deep
def test_planes_found_together_have_proposal_and_certificate_each(scene: Path, tmp_path: Path, done: Command) -> None:
    words = ("--joint", "--occlusion", *PATCHES, "--proposal", "--penalty-weight", 2)
    done("reconstruct", scene, *BOTH, *words, "--out", tmp_path)
    for method in ("joint", "occlusion"):
        planes = read_record(tmp_path / method)["planes"]
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
    by_patches = plane_files(tmp_path)
    assert "1 of 1 planes are there" in done(*words, *PATCHES).stderr
    assert "are there" not in done(*words, *PATCHES, "--proposal").stderr
    assert set(plane_files(tmp_path)) == {*by_patches, "plane_00500.0_proposal.tiff", "plane_00500.0_moved.tiff"}
    assert "are there" not in done(*words, "--prior", "tv").stderr
    by_variation = plane_files(tmp_path)
    assert set(by_variation) == set(by_patches)
    assert by_variation["plane_00500.0.tiff"] != by_patches["plane_00500.0.tiff"]


type Readings = list[tuple[str, list[str]]]


@pytest.fixture(scope="module")
def colour_plane(colour_set: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Readings]:
    """A plane by patches, and its colours in the order in which they were read, each with those still in memory."""
    out, read = tmp_path_factory.mktemp("whole"), list[tuple[str, list[str]]]()
    alive: list[tuple[str, weakref.ref[ElementalImages]]] = []

    def watched(elemental_set: ElementalSet, layout: ChannelLayout, *allocate: Any) -> ElementalImages:
        read.append((layout.name, [name for name, images in alive if images() is not None]))
        images = load_channel(elemental_set, layout, *allocate)
        alive.append((layout.name, weakref.ref(images)))
        return images

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep, "load_channel", watched)
        run_undrawn("reconstruct", colour_set, *NEAR, *QUICK, *PATCHES, "--out", out)
    return out, read


def _by_hand(folder: Path, depth_mm: float, settings: SolverOptions) -> list[Image]:
    """Each colour of a plane by the prior, with the sum of the other colours by total variation."""
    elemental_set = load_set(folder)
    objectives, first = [], []
    for layout in channel_layouts(elemental_set):
        images = load_channel(elemental_set, layout)
        operator = OperatorFactory(elemental_set, layout, images).at(depth_mm, plane_grid(elemental_set, depth_mm))
        objectives.append(Objective.of(SceneProblem(operator, images), settings))
        first.append(solve_pmlem(objectives[-1], as_pilot=True))
    red, green, blue = (solution.plane for (solution,) in first)
    others = [green + blue, red + blue, red + green]
    return [
        with_prior(replace(objective, other_colours=light), solution)[0].plane
        for objective, solution, light in zip(objectives, first, others, strict=True)
    ]


def test_each_colour_begins_with_sum_of_others(
    colour_set: Path, colour_plane: tuple[Path, Readings], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Held-out views judge candidates that know the other colours, too."""
    judged: list[Evidence] = []

    def watched(evidence: Evidence, names: Collection[str] | None = None) -> dict[str, Image]:
        judged.append(evidence)
        return patch_candidates(evidence, names)

    monkeypatch.setattr("faintfield.pipelines.reconstruction.planes.prior.patch_candidates", watched)
    plane = tifffile.imread(colour_plane[0] / "plane_00500.0.tiff")
    expected = _by_hand(colour_set, 500.0, SolverOptions(penalty_weight=2.0, passes=2, prior="patches"))
    np.testing.assert_allclose(np.moveaxis(plane, -1, 0), expected, atol=1e-4)
    records = read_record(colour_plane[0])["planes"]
    assert [record["channel"] for record in records] == ["red", "green", "blue"]
    assert "patches" in {record["prior"]["name"] for record in records}
    # Memory holds one colour at a time
    assert colour_plane[1] == [(name, []) for name in ("red", "green", "blue", "green", "red")]
    assert len(judged) >= 3 * 3  # colours times two folds and the whole
    assert len({evidence.coverage.sum(dtype=float) for evidence in judged}) == len(judged)
    for evidence in judged:
        assert evidence.other_colours is not None
        assert evidence.other_colours[evidence.coverage > 0].min() > 0


def test_planes_left_out_are_counted_once_in_colour(
    colour_set: Path, tmp_path: Path, done: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prior_module, "patch_candidates", lambda evidence, names=None: {"tv": evidence.pilot})
    ended = done("reconstruct", colour_set, *NEAR, *QUICK, *PATCHES, "--out", tmp_path)
    assert "the prior is left out of 1 of 1 planes, total variation's stay" in ended.stderr


@pytest.mark.deep
def test_joint_planes_begin_with_other_colours(
    colour_set: Path, tmp_path: Path, done: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    light: list[dict[Any, Image]] = []
    begun: list[dict[Any, tuple[Image, Image]]] = []

    def watched(factory: Any, images: Any, grids: Any, methods: Any, settings: Any, pilots: Any = None) -> Any:
        found = solve_together(factory, images, grids, methods, settings, pilots)
        if pilots is None:
            assert settings.prior == "tv"
            light.append({place: solution.plane for place, solution in found["joint"].items()})
        else:
            begun.append({place: (pilot.solution.plane, pilot.other_colours) for place, pilot in pilots.items()})
        return found

    monkeypatch.setattr(sweep, "solve_together", watched)
    both = (*NEAR, "--depth-mm", 700, "--joint")
    done("reconstruct", colour_set, *both, *QUICK, *PATCHES, "--out", tmp_path)
    assert len(light) == len(begun) == 3
    for own, pilots in zip(light, begun[::-1], strict=True):
        for place, (plane, others) in pilots.items():
            np.testing.assert_array_equal(plane, own[place])
            np.testing.assert_allclose(plane + others, np.sum([planes[place] for planes in light], axis=0), rtol=1e-5)
    assert len(plane_files(tmp_path)) == 2 * 3  # picture, preview and record


@pytest.mark.deep
def test_interrupted_colour_plane_is_completed_alike(
    colour_set: Path, colour_plane: tuple[Path, Readings], tmp_path: Path, faintfield: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    words = ("reconstruct", colour_set, *NEAR, *QUICK, *PATCHES, "--out", tmp_path)
    calls = []

    def failing(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) == 2:  # one colour is there
            raise GeometryMismatch("made up; wait")
        return solve(*arguments)

    monkeypatch.setattr(sweep, "solve", failing)
    assert faintfield(*words).returncode == 1
    assert {path.suffix for path in (tmp_path / ".parts").iterdir()} == {".float32", ".json"}
    assert faintfield(*words).returncode == 0
    assert plane_files(tmp_path) == plane_files(colour_plane[0])
