"""`simulate --objects surfaces`: a set like that of the toys, whose truth is one depth and one picture."""

import json
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest

from faintfield.pipelines.errors import InputError
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.ground_truth import read_truth
from faintfield.pipelines.reconstruction.overview import brightness

type Command = Callable[..., CompletedProcess[str]]

OPTIONS = ("--objects", "surfaces", "--size-px", 96, 72, "--rows", 3, "--columns", 3)


@pytest.fixture(params=["grey", "bayer"])
def colour(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def surfaces(tmp_path: Path, done: Command, colour: str) -> Path:
    done("simulate", tmp_path / "set", *OPTIONS, "--colour", colour)
    return tmp_path / "set"


def _all_files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_truth_is_the_depth_and_the_light_at_the_pixels_of_an_ideal_reference_view(
    surfaces: Path, colour: str
) -> None:
    views = [f"view_r{row}_c{column}.tiff" for row in range(3) for column in range(3)]
    own = ["elemental.toml", "flat.tiff", "noise_reference.tiff", "object_region.png", "provenance.json", "truth.json"]
    truth = ["truth/true_depth_mm.tiff", "truth/true_picture.tiff"]
    noise_free = [f"noise_free/{name}" for name in ("elemental.toml", "flat.tiff", *views)]
    assert set(_all_files(surfaces)) == {*views, *own, *truth, *noise_free}
    assert json.loads((surfaces / "provenance.json").read_text())["options"]["objects"] == "surfaces"
    stated = json.loads((surfaces / "truth.json").read_text())
    assert (stated["planes"], stated["surface"]) == ([], {"depth_mm": truth[0], "picture": truth[1]})
    depth, picture = (read_frame(surfaces / name).pixels_dn for name in truth)
    assert depth.dtype == picture.dtype == np.float32
    assert picture.shape == ((72, 96) if colour == "grey" else (72, 96, 3))
    # The first row shows the wall, which is turned about the vertical by 0.38 rad at 850 mm, up to the rod
    lens = load_set(surfaces).lens
    ray_x = (np.arange(96) - lens.cx_px) / lens.fx_px
    np.testing.assert_allclose(depth[0, :40], (850 / (1 - np.tan(0.38) * ray_x))[:40], rtol=1e-6)
    # Where the lens images an undistorted pixel, the noise-free view has its light
    free = load_set(surfaces / "noise_free")
    light = free.noise.electrons(read_frame(free.image_paths[4]).pixels_dn)
    light /= read_frame(surfaces / "flat.tiff").pixels_dn
    column, row = np.rint(lens.rays() @ np.diag([lens.fx_px, lens.fy_px]) + [lens.cx_px, lens.cy_px]).astype(int).T
    inside = ((column >= 0) & (column < 96) & (row >= 0) & (row < 72)).T
    filters = np.array([[0, 1], [1, 2]])[np.arange(72)[:, np.newaxis] % 2, np.arange(96) % 2]
    seen = picture[row.T[inside], column.T[inside]]
    if colour == "bayer":
        seen = np.take_along_axis(seen, filters[inside][:, np.newaxis], axis=1)[:, 0]
    assert np.corrcoef(seen, light[inside])[0, 1] > 0.85
    assert seen.mean() == pytest.approx(light[inside].mean(), rel=0.01)


def test_the_light_has_the_snr_that_is_asked_for(tmp_path: Path, done: Command) -> None:
    result = json.loads(done("--json", "simulate", tmp_path / "set", *OPTIONS, "--snr", 5).stdout)
    assert result["snr"] == pytest.approx(5, rel=1e-6)
    measured = brightness(load_set(tmp_path / "set"))
    assert measured.snr == pytest.approx(5, rel=0.1)


def test_the_same_seed_gives_the_same_bytes_and_another_the_same_truth_in_other_noise(
    tmp_path: Path, done: Command
) -> None:
    done("simulate", tmp_path / "first", *OPTIONS)
    done("simulate", tmp_path / "again", *OPTIONS)
    done("simulate", tmp_path / "other", *OPTIONS, "--seed", 2)
    first, again, other = (_all_files(tmp_path / name) for name in ("first", "again", "other"))
    assert first == again
    assert first["truth/true_depth_mm.tiff"] == other["truth/true_depth_mm.tiff"]
    assert first["view_r1_c1.tiff"] != other["view_r1_c1.tiff"]


def test_such_a_set_is_reconstructed_and_reported_without_the_toys_truth(surfaces: Path, done: Command) -> None:
    out = surfaces.parent / "planes"
    done("reconstruct", surfaces, "--depth-mm", 600, "--method", "backprojection", "--out", out)
    done("report", out)
    assert (out / "report.html").is_file()
    assert not (out / "metrics.json").exists()


def test_a_truth_that_names_files_outside_its_folder_is_refused(tmp_path: Path, done: Command) -> None:
    done("simulate", tmp_path / "set", *OPTIONS)
    path = tmp_path / "set" / "truth.json"
    truth = read_truth(path.parent)
    assert truth is not None
    assert truth.surface is not None
    for name in ("depth_mm", "picture"):
        stated = json.loads(path.read_text())
        stated["surface"][name] = "../elsewhere.tiff"
        (tmp_path / name).mkdir()
        (tmp_path / name / "truth.json").write_text(json.dumps(stated))
        with pytest.raises(InputError, match="elsewhere"):
            read_truth(tmp_path / name)


def test_a_set_of_toys_does_not_mention_objects(simulated_scene: Path) -> None:
    assert "objects" not in json.loads((simulated_scene / "provenance.json").read_text())["options"]
    assert "surface" not in json.loads((simulated_scene / "truth.json").read_text())
