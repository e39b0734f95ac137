"""Real photographs of a scene from a gantry: darkened, and seen again."""

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from faintfield.pipelines.cli import run
from faintfield.recon.metrics import mean_square_error, peak_snr_db

# The plane of the middle pieces: its points move by so much from node to node
_DISPARITY_PX = -2.0


def _run(*words: object) -> None:
    assert run([str(word) for word in words]) == 0


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The middle 5 x 5 of the chess photographs, cropped: bright and darkened sets, and a plane of either."""
    place = os.environ.get("FAINTFIELD_DATA")
    if not place:
        pytest.skip("FAINTFIELD_DATA does not name the folder of real data")
    folder = tmp_path_factory.mktemp("chess")
    (folder / "photographs").mkdir()
    for row, column in np.ndindex(5, 5):
        name = f"view_r{row + 2}_c{column + 2}"
        photograph = cv2.imread(str(Path(place) / "lightfield-chess" / f"{name}.jpg"))
        assert photograph is not None
        cv2.imwrite(str(folder / "photographs" / f"{name}.png"), photograph[140:340, 260:600])
    _run("import", "grid", folder / "photographs", folder / "bright", "--disparity-px", 2)
    _run("darken", folder / "bright", folder / "dark", "--snr", 0.16, "--seed", 1)
    plane = f"--disparity-px={_DISPARITY_PX}"
    _run("reconstruct", folder / "bright", "--out", folder / "of-bright", plane, "--method", "backprojection")
    methods = ("--method", "backprojection", "--method", "pmlem-osl", "--method", "pmlem")
    _run("reconstruct", folder / "dark", "--out", folder / "of-dark", plane, *methods, "--passes", 15)
    return folder


def _plane(folder: Path) -> Any:
    (path,) = folder.glob("plane_*.tiff")
    return tifffile.imread(path)


def test_penalised_planes_beat_the_mean_of_the_views(results: Path) -> None:
    scale_e = json.loads((results / "dark" / "provenance.json").read_text())["scale_e"]
    bright = _plane(results / "of-bright")
    assert bright.shape == (200, 340, 3)
    psnr_db = {
        method: peak_snr_db(mean_square_error(_plane(results / "of-dark" / method) / scale_e, bright))
        for method in ("backprojection", "pmlem-osl", "pmlem")
    }
    assert psnr_db["pmlem-osl"] >= psnr_db["backprojection"] + 8
    assert psnr_db["pmlem"] >= psnr_db["backprojection"] + 11


def test_nothing_can_be_seen_in_any_dark_view(results: Path) -> None:
    """A dark view says next to nothing of the bright one, pixel for pixel; the penalised plane says most of it."""
    bright, dark = (
        tifffile.imread(results / name / "view_r4_c4.tiff").mean(axis=2).ravel() for name in ("bright", "dark")
    )
    assert np.corrcoef(bright, dark)[0, 1] < 0.35
    planes = [_plane(results / name).ravel() for name in ("of-bright", "of-dark/pmlem-osl")]
    assert np.corrcoef(*planes)[0, 1] > 0.9


def test_colours_come_back(results: Path) -> None:
    scale_e = json.loads((results / "dark" / "provenance.json").read_text())["scale_e"]
    bright, penalised = (_plane(results / name).mean(axis=(0, 1)) for name in ("of-bright", "of-dark/pmlem-osl"))
    np.testing.assert_allclose(penalised / scale_e, bright, rtol=0.03)


def test_the_plane_is_where_the_disparity_puts_it(results: Path) -> None:
    record = json.loads((results / "of-dark" / "pmlem-osl" / "reconstruction.json").read_text())
    # Aligned at 1000 mm and 2 px: twice as far from infinity is half as far away
    assert [plane["depth_mm"] for plane in record["planes"]] == pytest.approx([500.0] * 3, rel=1e-12)
    assert [plane["channel"] for plane in record["planes"]] == ["red", "green", "blue"]
