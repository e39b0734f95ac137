"""Over-exposed objects: samples above saturation are NaN and hatched, the others true, and a message says so."""

from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest
import tifffile

from faintfield.pipelines.formats.results.surface import SurfaceChannel
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.planes.saturation import saturation_text
from tests.pipelines.conftest import Command, Edit, made_once, run_undrawn
from tests.pipelines.forms import read_record

PLANE = "plane_00500.0"


@pytest.fixture(scope="session")
def lit_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small set in bright light, to be read only."""
    words = ("--size-px", 80, 60, "--rows", 3, "--columns", 3, "--snr", 3000)
    return made_once(tmp_path_factory, "lit", lambda folder: run_undrawn("simulate", folder / "set", *words)) / "set"


def over_exposed(folder: Path, edit: Edit, bits: int) -> float:
    """Let a tenth of the pixels of a set saturate, at the last value of 8 or 16 bits; return that light in e⁻."""
    paths = sorted(folder.glob("view_*.tiff"))
    frames = [tifffile.imread(path) for path in paths]
    noise, level_dn = load_set(folder).noise, float(np.quantile(frames, 0.9))
    scale = (2**bits - 1) / level_dn
    for path, frame in zip(paths, frames, strict=True):
        tifffile.imwrite(path, np.clip(np.rint(frame * scale), 0, 2**bits - 1).astype(f"uint{bits}"))
    (folder / "noise_reference.tiff").unlink()

    def scaled(settings: dict[str, Any]) -> None:
        for name in ("gain_dn_per_e", "offset_dn"):
            settings["noise"][name] *= scale
        settings["noise"]["saturation_dn"] = 2.0**bits - 1

    edit(folder, scaled)
    return float((level_dn - np.mean(noise.offset_dn)) / np.mean(noise.gain_dn_per_e))


@pytest.mark.parametrize(
    ("bits", "words"),
    [(8, ("--uncertainty",)), (16, ("--joint", "--depth-mm", 700)), (16, ("--occlusion", "--depth-mm", 700))],
)
def test_samples_above_saturation_are_unknown(
    bits: int, words: tuple[object, ...], lit_scene: Path, tmp_path: Path, edit: Edit, done: Command
) -> None:
    folder, out = copytree(lit_scene, tmp_path / "set"), tmp_path / "out"
    saturation_e = over_exposed(folder, edit, bits)
    ended = done("reconstruct", folder, "--depth-mm", 500, "--prior", "tv", "--out", out, *words)
    plane = tifffile.imread(out / f"{PLANE}.tiff")
    truth = tifffile.imread(lit_scene / "truth" / f"{PLANE}.tiff")
    visible = tifffile.imread(lit_scene / "truth" / f"{PLANE}.tiff") > 0.1 * truth.max()
    unknown = np.isnan(plane)
    assert np.mean(unknown[truth > 1.2 * saturation_e]) > 0.95
    assert np.mean(unknown[visible & (truth < 0.8 * saturation_e)]) < 0.05
    assert "% of the pixels are saturated and do not count" in ended.stderr
    assert "seen mostly by such pixels: NaN, hatched magenta in the pictures; use a shorter exposure" in ended.stderr
    assert "% of the pixels are saturated and do not count" in (out / "report.html").read_text()
    record = read_record(out)["planes"][0]
    assert record["saturated_share"] == pytest.approx(0.1, abs=0.02)
    assert record["unknown_share"] == pytest.approx(unknown.mean())
    assert np.isfinite([record["mean_e"], record["flux_e"]]).all()
    assert record["certificate"]["reached"]
    if "--uncertainty" in words:
        sigma = tifffile.imread(out / f"{PLANE}_sigma.tiff")
        known = visible & ~unknown
        assert (np.isnan(sigma) == unknown).all()
        assert np.sqrt(np.mean(np.square((plane - truth)[known] / sigma[known]))) < 1.5


def test_share_of_one_saturated_pixel_is_not_zero() -> None:
    channel = SurfaceChannel(
        channel="grey", penalty_weight=None, penalty_weight_chosen="given", certificate=None, passes=1,
        likelihood="", mean_e=1.0, saturated_share=1 / 172_800, unknown_share=0.0,
    )  # fmt: skip
    text = saturation_text([channel])
    assert text is not None
    assert text.startswith("0.00058% of the pixels are saturated and do not count; use")
