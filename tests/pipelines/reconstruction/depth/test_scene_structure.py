"""The mode that suits a scene is told by its depths, if they tell."""

import json
from pathlib import Path

import pytest
from msgspec import UNSET, UnsetType

from faintfield.pipelines.formats.results.records import DepthMapRecord
from faintfield.pipelines.reconstruction.depth.scene_structure import recommendation
from tests.pipelines.conftest import Command, run_undrawn


def _record(shares: list[float] | UnsetType, sure_of_lit: float = 0.9) -> DepthMapRecord:
    return DepthMapRecord(
        "depth_mm.tiff", "depth_confidence.tiff", "all_in_focus.tiff", "mm", 2, 0.9, 0.2, 500.0, shares, sure_of_lit
    )


@pytest.mark.parametrize(
    ("shares", "words"),
    [
        ([0.5, 0.45], "2 separate depths: if nothing stands in between, planes there with --occlusion fit"),
        ([0.1, 0.2, 0.1], "continuum (40% of the samples of sure depth lie at the 3 depths that stand out): --surface"),
        ([0.6], "the depth that stands out): --surface fits it"),
        ([], "--surface fits it"),
    ],
)
def test_recommended_mode_follows_distribution_of_depths(shares: list[float], words: str) -> None:
    advice = recommendation(_record(shares))
    assert advice is not None
    assert words in advice
    assert recommendation(_record(shares), ("surface", "occlusion")) is None, "what was done is not recommended"
    assert recommendation(_record(shares, 0.07)) is None, "most of the light may lie elsewhere"


@pytest.mark.parametrize("shares", [[0.4, 0.38], [1.0], [0.93 / 7] * 7, UNSET])
def test_nothing_is_recommended_without_clear_evidence(shares: list[float] | UnsetType) -> None:
    assert recommendation(_record(shares)) is None


def test_mode_is_named_at_end_and_on_page(tmp_path: Path, done: Command) -> None:
    words = ("--objects", "surfaces", "--size-px", 96, 72, "--rows", 3, "--columns", 3, "--snr", 30, "--seed", 7)
    run_undrawn("simulate", tmp_path / "set", *words)
    method = ("--out", tmp_path / "out", "--method", "backprojection", "--depth-mm")
    assert "fits" not in done("reconstruct", tmp_path / "set", *method, 700).stderr
    ended = done("reconstruct", tmp_path / "set", *method, "auto", "--json")
    assert "--surface fits it" in ended.stderr.splitlines()[-1]
    assert json.loads(ended.stdout)["recommendation"] == ended.stderr.splitlines()[-1]
    assert "depths of this scene are a continuum" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.deep
def test_depth_map_names_mode_as_often_as_asked(tmp_path: Path, done: Command) -> None:
    words = ("--objects", "surfaces", "--size-px", 96, 72, "--rows", 5, "--columns", 5, "--snr", 300, "--seed", 7)
    run_undrawn("simulate", tmp_path / "set", *words)
    asked = ("--sweep-mm", "450:1100:6", "--depth-map", "--method", "backprojection", "--json")
    ends = [json.loads(done("reconstruct", tmp_path / "set", "--out", tmp_path / "out", *asked).stdout) for _ in "12"]
    assert "--surface fits it" in ends[0]["recommendation"]
    assert ends[1]["recommendation"] == ends[0]["recommendation"]
    assert "depths of this scene are a continuum" in (tmp_path / "out" / "report.html").read_text()
