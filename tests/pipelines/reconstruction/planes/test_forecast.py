"""The forecast of a sweep: in proportion to what is missing, and nothing written."""

import json
from pathlib import Path

import pytest

from faintfield.pipelines.reconstruction.planes import forecast as forecast_module
from tests.pipelines.conftest import Command

SWEEP = ("--sweep-mm", "500:700:3", "--method", "backprojection")


def _forecast(done: Command, *arguments: object) -> dict[str, float]:
    found: dict[str, float] = json.loads(done("reconstruct", *arguments, "--dry-run", "--json").stdout)
    return found


def test_forecast_is_of_missing_planes(
    colour_set: Path, tmp_path: Path, done: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forecast_module, "_times", lambda *_: (2.0, 0.5))
    monkeypatch.setattr(forecast_module, "_reading_s", lambda *_: 3.0)
    out = tmp_path / "out"
    whole, part = (_forecast(done, colour_set, "--out", out, *SWEEP, *of) for of in ((), ("--part", "1/2")))
    assert not out.exists()
    assert (whole["planes"], part["planes"]) == (3, 2)
    # A plane takes so many passes over green, which has two of four pixels: two passes over all pixels for each
    passes = (whole["seconds"] - part["seconds"]) / (2 * 2.0)
    assert passes == pytest.approx((part["seconds"] - 6.0) / (2 * 2 * 2.0))
    assert passes >= 1
    done("reconstruct", colour_set, "--out", out, *SWEEP, "--part", "1/2")
    assert _forecast(done, colour_set, "--out", out, *SWEEP)["seconds"] == pytest.approx(6.0 + 2 * 2.0 * passes)
    done("reconstruct", colour_set, "--out", out, *SWEEP)
    assert _forecast(done, colour_set, "--out", out, *SWEEP)["planes"] == 0


def test_prior_and_standard_deviations_take_more(
    scene: Path, tmp_path: Path, done: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forecast_module, "_times", lambda *_: (0.0, 1.0))
    plain, with_sigma, with_prior, with_both = (
        _forecast(done, scene, "--out", tmp_path / "out", "--depth-mm", "500", *options)
        for options in (
            ("--prior", "tv"),
            ("--prior", "tv", "--uncertainty"),
            ("--prior", "auto"),
            ("--prior", "auto", "--uncertainty"),
        )
    )
    assert plain["seconds"] < with_sigma["seconds"] < with_prior["seconds"] < with_both["seconds"]
    assert plain["memory_mb"] < with_prior["memory_mb"]


def test_plane_that_only_views_at_the_edge_see_has_a_forecast(
    scene: Path, tmp_path: Path, done: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Views that see it are timed, not those in the middle of all."""
    monkeypatch.setattr(forecast_module, "_VIEWS", 1)
    pose = tmp_path / "aside.toml"
    plane = ('name = "aside"', "point_mm = [-230, 0, 500]", "normal = [0, 0, -1]", "size_mm = [20, 20]")
    pose.write_text("\n".join(("format = 1", "[[plane]]", *plane)))
    found = _forecast(done, scene, "--out", tmp_path / "out", "--plane-pose", pose, "--method", "backprojection")
    assert found["planes"] == 1
    assert found["seconds"] > 0


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--surface",), "knows no time of --surface"),
        ((*SWEEP, "--workers", "2"), "knows no time of --workers"),
        (("--depth-mm", "auto"), "does not search depths"),
        (("--depth-mm", "500", "--depth-mm", "700", "--joint"), "solved together"),
    ],
)
def test_what_has_no_forecast_is_refused(
    options: tuple[str, ...], reason: str, scene: Path, tmp_path: Path, faintfield: Command
) -> None:
    ended = faintfield("reconstruct", scene, "--out", tmp_path / "out", *options, "--dry-run")
    assert ended.returncode == 2
    assert reason in ended.stderr
    assert not (tmp_path / "out").exists()
