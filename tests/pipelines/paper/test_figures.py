"""`figures`: the paper's figures with their numbers, and the page that shows them."""

import csv
import json
import shutil
import statistics
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path

import msgspec
import numpy as np
import pytest

from faintfield.pipelines.paper import figure4, figure_drawings, figures
from faintfield.pipelines.paper.figure4 import (
    METHODS,
    SNRS,
    CurvePoint,
    ErrorPoint,
    StagedObject,
    is_monotone,
    mean_curves,
    over_best,
    stage_object,
)
from faintfield.recon.metrics import expected_snr_from_powers
from faintfield.rig.simulation.objects import shaded_ball, star_chart, toy_truck
from tests.pipelines.conftest import Command, run_undrawn

FEW_SNRS = figure4.SNRS[::7]
FAST_METHODS = [method for method in METHODS if method.name not in ("bm3d", "pmlem-patches")]
OBJECTS = {"truck", "ball"}


def make_figures(out: Path, *words: object) -> Path:
    """Make figures, small and with empty drawings."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figure4, "SNRS", FEW_SNRS)
        patch.setattr(figure4, "OBJECTS", (toy_truck, shaded_ball))
        for module in (figure4, figure_drawings, figures):
            patch.setattr(module, "METHODS", [replace(method, weights=method.weights[2:3]) for method in FAST_METHODS])
        run_undrawn("figures", out, *words)
    return out


@pytest.fixture(scope="module")
def figure_4(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Figure 4 alone, to be read only."""
    out = tmp_path_factory.mktemp("figures") / "out"
    return make_figures(out, "--size-px", 64, 48, "--only", 4, "--seeds", 1)


@pytest.fixture(scope="module")
def made(figure_4: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All figures, to be read only."""
    out = Path(shutil.copytree(figure_4, tmp_path_factory.mktemp("all") / "out"))
    return make_figures(out, "--size-px", 96, 72, "--only", 2, 3)


@pytest.fixture(scope="module")
def star() -> StagedObject:
    return stage_object(star_chart(0.0, 0.0, 600.0).grey(), (120, 90))


def test_errors_of_figure_4_are_those_of_paper(figure_4: Path) -> None:
    errors = msgspec.json.decode((figure_4 / "figure4.json").read_bytes(), type=list[ErrorPoint])
    assert SNRS == (0.16, 0.17, 0.18, 0.19, 0.20, 0.21, 0.22, 0.23)
    error = {(row.object, row.snr, row.method, row.seed): row.mse for row in errors}
    names = [method.name for method in FAST_METHODS]
    assert set(error) == {(name, snr, method, 1) for name in OBJECTS for snr in FEW_SNRS for method in names}
    assert len(errors) == len(error)
    for name, method in product(OBJECTS, ("backprojection", "pmlem-osl", "pmlem")):
        assert all(
            error[name, brighter, method, 1] < error[name, darker, method, 1] for darker, brighter in pairwise(FEW_SNRS)
        )
    by_method = {method.name: [row.mse for row in errors if row.method == method.name] for method in FAST_METHODS}
    assert max(by_method["pmlem-osl"] + by_method["pmlem"]) < 0.12
    for name, snr, method in product(OBJECTS, FEW_SNRS, ("pmlem-osl", "pmlem", "pmlem-auto")):
        assert error[name, snr, method, 1] < error[name, snr, "backprojection", 1] / 2


@pytest.mark.parametrize("number", [pytest.param(3, marks=pytest.mark.deep), 4])
def test_table_holds_what_json_holds(number: int, request: pytest.FixtureRequest) -> None:
    made: Path = request.getfixturevalue("figure_4" if number == 4 else "made")
    content = json.loads((made / f"figure{number}.json").read_text())
    rows = content if number == 4 else content["planes"]
    with (made / f"figure{number}.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(rows)
    for row, cells in zip(rows, table, strict=True):
        assert {name: "" if value is None else str(value) for name, value in row.items()} == cells


@pytest.mark.deep
def test_figures_2_and_3_show_sharpness_and_darkness(made: Path) -> None:
    rows = json.loads((made / "figure2.json").read_text())["planes"]
    assert {(row["plane_depth_mm"], row["object"]) for row in rows} == {
        (depth, name) for depth in (500.0, 700.0) for name in ("truck", "airplane")
    }
    for row in rows:
        own = row["plane_depth_mm"] == row["object_depth_mm"]
        assert row["detail"] > 0.5 if own else abs(row["detail"]) < 0.2
    content = json.loads((made / "figure3.json").read_text())
    assert content["snr"]["asked"] == pytest.approx(0.16)
    assert content["photons_per_px"]["linear"] == pytest.approx(0.16 * 12 / 0.5)
    assert [row["depth_mm"] for row in content["planes"]] == [500.0, 700.0]


@pytest.mark.deep
def test_figures_that_are_not_asked_for_stay(made: Path, tmp_path: Path, done: Command) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    for path in {*out.glob("figure4*")} - {out / "figure4.png"}:
        path.unlink()  # the picture is left, as of a figure that was cut short
    before = (out / "figure3.png").read_bytes()
    message = json.loads(done("--json", "figures", out, "--only", 2, "--size-px", 64, 48).stdout)
    assert list(message["figures"]) == ["figure2"]
    assert (out / "figure3.png").read_bytes() == before
    page = (out / "figures.html").read_text()
    assert [f'id="figure{number}"' in page for number in (2, 3, 4)] == [True, True, False]
    whole = (made / "figures.html").read_text()
    for words in ("In the paper", "Here", "from 0 to 0.12", *(method.title for method in FAST_METHODS)):
        assert words in whole
    assert "http" not in whole.split("</head>")[1]


def test_exposures_have_their_snr_and_share_photons(star: StagedObject) -> None:
    view = star.experiment.reference_view
    signal = star.light[view][star.region]
    for snr, images, scale_e in star.exposures(seed=3):
        assert expected_snr_from_powers(signal * scale_e, 0.02, 12**0.5) == pytest.approx(snr)
        # The sum over all pixels of all views is a Poisson number and a sum of read noises
        expected = float(star.light.sum() * scale_e + 0.02 * star.light.size)
        deviation = np.sqrt(expected + (12 + 1 / 48) * star.light.size)
        assert images.electrons.sum(dtype=np.float64) == pytest.approx(expected, abs=4 * deviation)
    frames = [images.electrons for _, images, _ in star.exposures(seed=3)]
    for darker, brighter in pairwise(frames):
        more = brighter - darker
        np.testing.assert_array_equal(more, np.rint(more))
        assert more.min() >= 0
    other = next(star.exposures(seed=4))[1].electrons
    assert np.corrcoef(frames[0].ravel(), other.ravel())[0, 1] < 0.2


def test_point_has_mean_and_standard_error_of_draws() -> None:
    draws = [ErrorPoint("star", 0.16, "tv", mse, seed, 2 * mse, None) for seed, mse in enumerate((0.01, 0.02, 0.06))]
    (point,) = mean_curves(draws)
    assert (point.mse, point.mse_texture) == pytest.approx((0.03, 0.06))
    assert point.standard_error == pytest.approx(statistics.stdev((0.01, 0.02, 0.06)) / 3**0.5)
    assert mean_curves(draws[:1])[0].standard_error is None


def test_plane_covers_its_object_with_sampling_errors(star: StagedObject) -> None:
    ball = stage_object(shaded_ball(0.0, 0.0, 600.0).grey(), (120, 90))
    assert ball.errors(ball.bright * np.float32(2.0), 2.0)[0] == pytest.approx(0.0, abs=1e-12)
    assert ball.errors(ball.bright, 1.0)[1] < 2e-3
    shown = np.zeros_like(star.region)
    shown[star.window] = True
    assert shown[star.region].all()
    assert shown.sum() < 0.5 * shown.size
    assert star.texture.shape == star.bright.shape == star.operator.grid.shape == star.region[star.window].shape
    # Where the reference view sees the object, the plane holds it: up to the blur of sampling
    assert np.corrcoef(star.texture.ravel(), star.region[star.window].ravel())[0, 1] > 0.5
    assert np.corrcoef(star.texture.ravel(), star.bright.ravel())[0, 1] > 0.95


def test_table_of_peer_counts_for_its_own_exposures() -> None:
    table = figure4.read_peer_table()
    measured = [error for error in table.errors if error.method == figure4.BACK_PROJECTION]
    peers = figure4.peer_errors(measured)
    assert {(error.object, error.snr, error.seed) for error in peers} == set(
        product(("truck", "airplane", "boat", "ball"), SNRS, (1, 2))
    )
    assert all(0 < error.mse < 0.01 for error in peers)
    brighter = [msgspec.structs.replace(error, mse=0.9 * error.mse) for error in measured]
    assert not figure4.peer_errors(brighter)
    assert len(figure4.peer_errors(brighter[1:] + measured[:1])) == 1


def test_curves_are_judged_by_worst_object() -> None:
    def curves(**errors: tuple[float, ...]) -> list[CurvePoint]:
        return [
            CurvePoint(name, method, snr, draws=1, mse=mse, standard_error=None, mse_texture=mse)
            for (name, method), curve in ((key.split("_"), value) for key, value in errors.items())
            for snr, mse in zip((0.16, 0.17, 0.18), curve, strict=False)
        ]

    for ball, falls in (((3.0, 2.0, 1.0), True), ((3.0, 3.0, 1.0), False), ((3.0, 1.0, 2.0), False)):
        assert is_monotone(curves(star_tv=(3.0, 2.0, 1.0), ball_tv=ball), "tv") == falls
    points = curves(star_ours=(2.2, 1.5), star_best=(2.0, 1.0), ball_ours=(1.0, 0.9), ball_best=(1.0, 1.0))
    assert over_best(points, "ours", "best") == pytest.approx({"star": 1.5, "ball": 1.0})
