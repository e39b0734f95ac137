"""The mode that suits a scene is told by its depths, if they tell."""

import json
from pathlib import Path

import pytest

from faintfield.pipelines.reconstruction.depth.scene_structure import recommendation
from tests.pipelines.conftest import Command, run_undrawn


@pytest.mark.parametrize(
    ("shares", "words"),
    [
        ([0.5, 0.45], "2 separate depths: planes there with --occlusion fit"),
        ([0.1, 0.2, 0.1], "continuum (40% of the samples of sure depth lie at the 3 depths that stand out): --surface"),
        ([0.6], "the depth that stands out): --surface fits it"),
        ([], "--surface fits it"),
    ],
)
def test_recommended_mode_follows_distribution_of_depths(shares: list[float], words: str) -> None:
    advice = recommendation(shares)
    assert advice is not None
    assert words in advice


@pytest.mark.parametrize("shares", [[0.4, 0.38], [1.0], [0.93 / 7] * 7, None])
def test_nothing_is_recommended_without_clear_evidence(shares: list[float] | None) -> None:
    assert recommendation(shares) is None


def test_mode_is_named_at_end_and_on_page(tmp_path: Path, done: Command) -> None:
    words = ("--objects", "surfaces", "--size-px", 96, 72, "--rows", 3, "--columns", 3, "--snr", 30, "--seed", 7)
    run_undrawn("simulate", tmp_path / "set", *words)
    method = ("--out", tmp_path / "out", "--method", "backprojection", "--depth-mm")
    assert "fits" not in done("reconstruct", tmp_path / "set", *method, 700).stderr
    ended = done("reconstruct", tmp_path / "set", *method, "auto", "--json")
    assert "--surface fits it" in ended.stderr.splitlines()[-1]
    assert json.loads(ended.stdout)["recommendation"] == ended.stderr.splitlines()[-1]
    assert "--surface fits it" in (tmp_path / "out" / "report.html").read_text()
