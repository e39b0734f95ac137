"""Real photographs of a scene from a gantry: darkened, and seen again."""

import json
import os
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from faintfield.pipelines.cli import run
from faintfield.recon.metrics import mean_square_error, peak_snr_db

pytestmark = pytest.mark.deep

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


def _electrons_of_white(results: Path) -> float:
    """The electrons of the dark set of what is white, 1, in planes of the bright one, whose gain is an estimate."""
    gain = tomllib.loads((results / "bright" / "elemental.toml").read_text())["noise"]["gain_dn_per_e"]
    scale_e = json.loads((results / "dark" / "provenance.json").read_text())["scale_e"]
    return float(scale_e * 65535 / gain)


def test_penalised_planes_beat_mean_of_views(results: Path) -> None:
    white_e, bright = _electrons_of_white(results), _plane(results / "of-bright")
    assert bright.shape == (200, 340, 3)
    known = np.isfinite(bright)  # but for the places that are saturated in the photographs
    assert known.mean() > 0.95
    psnr_db = {
        method: peak_snr_db(mean_square_error(_plane(results / "of-dark" / method)[known] / white_e, bright[known]))
        for method in ("backprojection", "pmlem-osl", "pmlem")
    }
    assert psnr_db["pmlem-osl"] >= psnr_db["backprojection"] + 14
    assert psnr_db["pmlem"] >= psnr_db["backprojection"] + 17


def test_dark_view_shows_nothing(results: Path) -> None:
    """A dark view says next to nothing of the bright one, pixel for pixel; the penalised plane says most of it.

    The light of photographs, their curve undone, is mostly that of a few bright places: the rest has 0.07 electrons.
    """
    bright, dark = (
        tifffile.imread(results / name / "view_r4_c4.tiff").mean(axis=2).ravel() for name in ("bright", "dark")
    )
    assert np.corrcoef(bright, dark)[0, 1] < 0.15
    planes = {name: _plane(results / name).ravel() for name in ("of-bright", "of-dark/pmlem-osl", "of-dark/pmlem")}
    known = np.isfinite(planes["of-bright"])
    planes = {name: plane[known] for name, plane in planes.items()}
    assert np.corrcoef(planes["of-bright"], planes["of-dark/pmlem-osl"])[0, 1] > 0.75
    assert np.corrcoef(planes["of-bright"], planes["of-dark/pmlem"])[0, 1] > 0.85


def test_colours_come_back(results: Path) -> None:
    """Within three standard errors of the mean of a colour, which 25 views of 68 000 px of read noise leave."""
    bright, penalised = (_plane(results / name) for name in ("of-bright", "of-dark/pmlem"))
    known = np.isfinite(bright)
    bright, penalised = (np.mean(plane, axis=(0, 1), where=known) for plane in (bright, penalised))
    expected_e = bright * _electrons_of_white(results)
    standard_error_e = (3.464**2 + expected_e.max()) ** 0.5 / (25 * 200 * 340) ** 0.5
    np.testing.assert_allclose(penalised, expected_e, atol=3 * standard_error_e)


def test_photographs_that_were_shifted_and_turned_are_aligned_by_the_import(tmp_path: Path) -> None:
    """The import finds by how much each view was shifted and turned, but for a drift, which is another depth."""
    place = os.environ.get("FAINTFIELD_DATA")
    if not place:
        pytest.skip("FAINTFIELD_DATA does not name the folder of real data")
    generator = np.random.default_rng(1)
    moves = {node: (*generator.uniform(-3, 3, 2), generator.uniform(-0.5, 0.5)) for node in np.ndindex(7, 7)}
    moves[3, 3] = (0.0, 0.0, 0.0)
    (tmp_path / "photographs").mkdir()
    for (row, column), (right, down, turn_deg) in moves.items():
        photograph = cv2.imread(str(Path(place) / "lightfield-chess" / f"view_r{row + 1}_c{column + 1}.jpg"))
        assert photograph is not None
        height, width = photograph.shape[:2]
        matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), turn_deg, 1)
        matrix[:, 2] += right, down
        moved = cv2.warpAffine(
            photograph, matrix, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )
        cv2.imwrite(str(tmp_path / "photographs" / f"view_r{row}_c{column}.png"), moved)
    _run("import", "grid", tmp_path / "photographs", tmp_path / "set")
    views = json.loads((tmp_path / "set" / "alignment" / "geometry.json").read_text())["views"]
    wanted = np.array([moves[tuple(view["node"])] for view in views])
    found = np.array([(*view["shift_px"], -np.degrees(view["turn_rad"])) for view in views])
    drift = np.column_stack([np.ones(len(views)), [view["node"] for view in views]])
    left = found - wanted
    left -= drift @ np.linalg.lstsq(drift, left)[0]
    assert np.sqrt(np.mean(left**2, axis=0)) == pytest.approx([0, 0, 0], abs=0.15)
