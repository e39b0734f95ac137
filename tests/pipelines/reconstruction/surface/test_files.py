"""The files of a surface: what is written is what was found, and nothing vouches for anything else."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from faintfield.pipelines.commands.capture import verify
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.surface import SURFACE_FILE, surfaces_below
from faintfield.pipelines.formats.results.verification import records_of, verify_results
from faintfield.pipelines.reconstruction.depth.depth_map import robust_limits
from faintfield.pipelines.reconstruction.surface.files import write_surface
from tests.pipelines.by_hand import write_by_hand
from tests.pipelines.forms import flip_last_bit, read_record
from tests.pipelines.surfaces import OPTIONS, SHAPE, surface_facts, surface_maps, write_example

# Every file of a surface in mm.
MAPS = ("picture", "picture_sigma", "depth_mm", "depth_sigma_mm", "depth_confidence", "visibility")
FILES = {"surface.ply", "parallax.webp", *(f"{name}{suffix}" for name in MAPS for suffix in (".tiff", ".png"))}


@pytest.fixture
def surface(written_surface: Path, tmp_path: Path) -> Path:
    """A copy of the surface that a test may change."""
    return Path(shutil.copytree(written_surface, tmp_path / "surface"))


def test_maps_are_written_and_recorded_as_they_are(written_surface: Path) -> None:
    maps, record = surface_maps(), surfaces_below(written_surface)[written_surface]
    assert {path.name for path in written_surface.iterdir()} == FILES | {SURFACE_FILE}
    assert set(record.files) == FILES == set(record.sha256)
    for name in MAPS:
        found = tifffile.imread(written_surface / f"{name}.tiff")
        assert (str(found.dtype), found.shape) == ("float32", SHAPE)
        np.testing.assert_allclose(found, getattr(maps, name.removesuffix("_mm")), rtol=1e-6)  # NaN where it is NaN
    ball = sum((r - 40) ** 2 + (c - 50) ** 2 < 400 for r in range(90) for c in range(120))
    shares = record.surface.known_share, record.surface.sure_share
    assert shares == pytest.approx((1 - 9 * 19 / (90 * 120), ball / (90 * 120)))
    assert record.surface.median == pytest.approx(np.nanmedian(maps.depth))
    assert record.surface.shape == SHAPE


def test_colours_are_kept_and_disparities_named_as_such(tmp_path: Path) -> None:
    record = write_example(tmp_path, unit="px", colours=3)
    assert (record.depth, record.depth_sigma, record.points) == ("disparity_px.tiff", "disparity_sigma_px.tiff", None)
    assert not (tmp_path / "surface.ply").exists()  # no length is known
    found = tifffile.imread(tmp_path / "picture.tiff")
    np.testing.assert_allclose(found, surface_maps(colours=3).picture, rtol=1e-6)
    shown = cv2.imdecode(np.fromfile(tmp_path / "picture.png", np.uint8), cv2.IMREAD_COLOR_RGB)
    assert shown is not None
    assert shown.shape == (*SHAPE, 3)
    ratio = shown[40, 50].astype(float) / found[40, 50]
    assert ratio.max() < 1.05 * ratio.min()  # red stays red


def test_points_are_known_samples(written_surface: Path) -> None:
    header, _, body = (written_surface / "surface.ply").read_bytes().partition(b"end_header\n")
    points = np.frombuffer(body, [("place", "<f4", 3), ("rest", "V15")])["place"]
    depth = surface_maps().depth
    rows, columns = np.nonzero(np.isfinite(depth))
    assert f"element vertex {len(rows)}\n".encode() in header
    z = depth[rows, columns]
    expected = np.column_stack([z * (columns - 59.5) / 150, z * (rows - 44.5) / 150, z])
    np.testing.assert_allclose(points, expected, rtol=1e-5, atol=1e-4)


def test_film_repeats_for_ever_and_shows_picture(written_surface: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    with image.open(written_surface / "parallax.webp") as film:
        assert (film.format, film.n_frames, film.info["loop"]) == ("WEBP", 24, 0)
        assert film.width <= 480
        means = []
        for number in range(film.n_frames):
            film.seek(number)
            means.append(np.asarray(film.convert("L"), float).mean())
        assert film.info["duration"] == 80
    assert np.std(means) < 0.05 * np.mean(means)


def test_surface_of_which_nothing_is_known_is_written(tmp_path: Path) -> None:
    nothing = np.full(SHAPE, np.nan)
    maps = replace(surface_maps(), depth=nothing, depth_sigma=nothing)
    record = write_surface(tmp_path, maps, surface_facts(), provenance("reconstruct", OPTIONS, {}))
    assert (record.known_share, record.median) == (0, None)
    assert verify(tmp_path).results is not None


def test_verify_compares_every_file(surface: Path) -> None:
    for path in (surface, surface / SURFACE_FILE):
        verdict = verify(path).results
        assert verdict is not None
        assert (verdict.records, verdict.files, verdict.problems) == (1, len(FILES), ())
    for name in sorted(FILES):
        flip_last_bit(surface / name)
        (problem,) = verify_results(records_of(surface)).problems
        assert f"{name}: was altered" in problem
        flip_last_bit(surface / name)


@pytest.mark.parametrize("changes", [{"picture": "../picture.tiff"}, {"film": "/dev/zero"}], ids=str)
def test_impossible_surface_is_refused(changes: dict[str, Any], surface: Path) -> None:
    content = read_record(surface, SURFACE_FILE)
    content["surface"].update(changes)
    write_by_hand(surface / SURFACE_FILE, content)
    with pytest.raises(BadValue, match="is not a result that can be shown"):
        surfaces_below(surface)


def test_limits_of_map_leave_outliers_out() -> None:
    values = np.linspace(100, 200, 10_001)
    values[[0, 5, 9]] = 1e9, -1e9, np.nan
    assert robust_limits(values) == pytest.approx((101, 199), abs=0.1)
    assert robust_limits(np.full(5, np.nan)) == (0, 1)
    for level in (3.0, 0.0):
        low, high = robust_limits(np.full(5, level))
        assert low < level < high


def test_missing_encoder_leaves_out_the_film(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delattr(cv2, "imencodeanimation")
    write_example(tmp_path)
    assert surfaces_below(tmp_path)[tmp_path].surface.film is None
    assert {path.name for path in tmp_path.iterdir()} == FILES - {"parallax.webp"} | {SURFACE_FILE}
    assert "OpenCV 4.12 or later" in capsys.readouterr().err
