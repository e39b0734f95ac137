"""`simulate`: what is written is what the simulated world gives, with its truth beside it."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.pipelines.errors import InputError
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.ground_truth import Truth, read_truth
from faintfield.pipelines.reconstruction.overview import brightness
from faintfield.recon.metrics import photons_from_linear_snr, photons_from_moments
from faintfield.rig.simulation.experiment import paper_experiment
from faintfield.rig.simulation.scene import render
from tests.pipelines.conftest import SMALL, Command
from tests.pipelines.forms import files_in, read_record
from tests.pipelines.noise_sets import check_noise_of_eq_6, deviation_of_snr

# The paper's camera
READ_NOISE_E, ETA, DARK_E, GAIN, OFFSET_DN = 12**0.5, 0.5, 0.2 * 0.1, 2.0, 100.0

READ_VARIANCE_E2 = 12 + 1 / 12 / GAIN**2


def _truth(folder: Path) -> Truth:
    truth = read_truth(folder)
    assert truth is not None
    return truth


def _electrons(folder: Path) -> NDArray[np.float32]:
    elemental_set = load_set(folder)
    return np.stack([elemental_set.noise.electrons(read_frame(path).pixels_dn) for path in elemental_set.image_paths])


VIEWS = {f"view_r{row}_c{column}.tiff" for row in range(3) for column in range(3)}
FILES = {
    *VIEWS,
    *("elemental.toml", "flat.tiff", "noise_reference.tiff", "object_region.png", "provenance.json", "truth.json"),
    *(f"noise_free/{name}" for name in ("elemental.toml", "flat.tiff", *VIEWS)),
}


def test_set_holds_views_noise_reference_and_truth(simulated_scene: Path) -> None:
    truth = {f"truth/{name}" for z in ("00500.0", "00700.0") for name in (f"plane_{z}.tiff", f"visible_{z}.png")}
    assert set(files_in(simulated_scene)) == FILES | truth
    for name in (*VIEWS, "noise_reference.tiff"):
        frame = read_frame(simulated_scene / name).pixels_dn
        assert frame.shape == (72, 96)
        assert frame.dtype == np.uint16


def test_other_seed_gives_other_noise(simulated_scene: Path, tmp_path: Path, done: Command) -> None:
    done("simulate", tmp_path / "other", *SMALL, "--seed", 2)
    first, other = (files_in(folder) for folder in (simulated_scene, tmp_path / "other"))
    assert set(first) == set(other)
    same = {name for name in first if first[name] == other[name]}
    # What chance has no part in: the lens, and what the reference camera would see of each object
    assert same >= {"flat.tiff", "noise_free/flat.tiff", "truth/visible_00500.0.png"}
    assert not any("view" in name or "reference" in name for name in same)


def test_noise_free_set_holds_electrons_of_rays(simulated_scene: Path) -> None:
    truth, experiment = _truth(simulated_scene), paper_experiment(96, 72).grey()
    light = [view.light for view in render(experiment.planes, experiment.optics, np.array(truth.true_rt_cam_ref))]
    region = read_frame(simulated_scene / "object_region.png").pixels_dn > 127
    scale_e = truth.photons_on_object * ETA / light[4][region].mean(dtype=float)
    found, expected = _electrons(simulated_scene / "noise_free"), np.stack(light) * scale_e
    np.testing.assert_allclose(found, expected, atol=0.51 / 60_000 * expected.max())  # 16 bits, rounded
    settings = load_set(simulated_scene / "noise_free").settings
    np.testing.assert_array_equal([view.rt_cam_ref for view in settings.view], truth.true_rt_cam_ref)


def test_dark_views_have_noise_of_eq_6(simulated_scene: Path) -> None:
    expected = _electrons(simulated_scene / "noise_free").astype(float) + DARK_E
    check_noise_of_eq_6(_electrons(simulated_scene), expected, READ_VARIANCE_E2)


@pytest.mark.parametrize("snr", [0.16, 20.0])
def test_measured_snr_is_that_asked_for(snr: float, tmp_path: Path, done: Command) -> None:
    options = ("--size-px", 320, 240, "--rows", 1, "--columns", 1)
    result = json.loads(done("--json", "simulate", tmp_path / "set", "--snr", snr, *options).stdout)
    assert result["snr"] == pytest.approx(snr, rel=1e-6)
    measured = brightness(load_set(tmp_path / "set"))
    assert (measured.region, measured.noise_from) == ("object region", "noise reference")
    assert measured.snr is not None
    region = read_frame(tmp_path / "set" / "object_region.png").pixels_dn > 127
    mean_e = _electrons(tmp_path / "set" / "noise_free")[0][region].astype(float)
    deviation = deviation_of_snr(snr, mean_e, READ_VARIANCE_E2, region)
    assert measured.snr == pytest.approx(snr, abs=4 * deviation)
    assert deviation < 0.15 * snr


def test_photons_are_stated_by_formula_and_by_count(simulated_scene: Path) -> None:
    truth = _truth(simulated_scene)
    known = {"quantum_efficiency": ETA, "read_noise_e": READ_NOISE_E}
    assert truth.photons_linear == pytest.approx(photons_from_linear_snr(0.16, **known))
    assert truth.photons_linear == pytest.approx(3.84)
    assert truth.photons_from_moments == pytest.approx(photons_from_moments(0.16, dark_e=DARK_E, **known))
    region = read_frame(simulated_scene / "object_region.png").pixels_dn > 127
    on_object = _electrons(simulated_scene / "noise_free")[4][region].mean(dtype=float) / ETA
    assert truth.photons_on_object == pytest.approx(on_object, rel=1e-4)


def test_truth_planes_are_seen_in_reference_view(simulated_scene: Path) -> None:
    """Undistorted, the noise-free reference view is the texture wherever its object is visible."""
    truth, view = _truth(simulated_scene), _electrons(simulated_scene / "noise_free")[4]
    lens = load_set(simulated_scene).lens
    rays = lens.rays()
    flat = read_frame(simulated_scene / "flat.tiff").pixels_dn
    seen = np.rint(rays @ np.diag([lens.fx_px, lens.fy_px]) + [lens.cx_px, lens.cy_px]).astype(int)
    inside = ((seen >= 1) & (seen < (95, 71))).all(axis=2)
    assert [(plane.name, plane.depth_mm) for plane in truth.planes] == [("truck", 500.0), ("airplane", 700.0)]
    for plane in truth.planes:
        texture = read_frame(simulated_scene / plane.texture).pixels_dn
        visible = read_frame(simulated_scene / plane.visible).pixels_dn > 127
        assert texture.dtype == np.float32
        assert 0.03 < visible.mean() < 0.3
        column, row = seen[inside].T
        # Pixels on the object's edge and on fine detail differ by what half a pixel holds
        there = visible[row, column]
        difference = (view / flat)[inside][there] - texture[row, column][there]
        assert np.sqrt(np.mean(difference**2)) < 0.1 * texture[visible].mean()
        assert abs(difference.mean()) < 0.02 * texture[visible].mean()


def test_set_states_true_or_nominal_poses(simulated_scene: Path, tmp_path: Path, done: Command) -> None:
    done("simulate", tmp_path / "set", *SMALL, "--poses", "nominal")
    nodes = np.array([view.node for view in load_set(simulated_scene).settings.view])
    nominal = np.zeros((9, 6))
    nominal[:, 3:5] = 50.0 * (1 - nodes[:, ::-1])
    true = np.array(_truth(simulated_scene).true_rt_cam_ref)
    for folder, poses, stated in ((simulated_scene, "true", true), (tmp_path / "set", "nominal", nominal)):
        assert _truth(folder).poses == poses
        np.testing.assert_array_equal(load_set(folder).poses_rt_cam_ref, stated)
    options = ("--position-error-mm", 0, "--rotation-error-mrad", 0, "--pitch-mm", 20)
    done("simulate", tmp_path / "perfect", *SMALL, *options)
    poses_of_perfect = load_set(tmp_path / "perfect").poses_rt_cam_ref
    assert np.unique(poses_of_perfect[:, 3:5]).tolist() == [-20.0, 0.0, 20.0]
    assert not poses_of_perfect[:, [0, 1, 2, 5]].any()
    errors = np.delete(true - nominal, 4, axis=0)
    np.testing.assert_array_equal((true - nominal)[4], 0.0)
    # 24 numbers each: their deviation is known to a seventh
    assert errors[:, 3:].std() == pytest.approx(0.3, rel=4 / np.sqrt(48))
    assert errors[:, :3].std() == pytest.approx(3.5e-3, rel=4 / np.sqrt(48))


def test_bayer_pixel_has_colour_of_its_filter(colour_set: Path) -> None:
    assert load_set(colour_set).settings.camera.mosaic == ("RG", "GB")
    truth, experiment = _truth(colour_set), paper_experiment(64, 48)
    colours = next(render(experiment.planes, experiment.optics, np.array(truth.true_rt_cam_ref)[4:5])).light
    found = _electrons(colour_set / "noise_free")[4]
    scale_e = found.sum() / sum(
        colours[r::2, c::2, i].sum() for r, c, i in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2))
    )
    for row, column, colour in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        expected = scale_e * colours[row::2, column::2, colour]
        np.testing.assert_allclose(found[row::2, column::2], expected, atol=2e-4 * found.max())
    assert read_frame(colour_set / "truth" / "plane_00500.0.tiff").pixels_dn.shape == (48, 64, 3)


@pytest.mark.parametrize("colour", ["grey", "bayer"])
def test_truth_of_surfaces_is_depth_and_light(colour: str, tmp_path: Path, done: Command) -> None:
    """Both are those at the pixels of an ideal reference view."""
    surfaces, snr = tmp_path / "set", 5.0
    words = ("simulate", surfaces, "--objects", "surfaces", *SMALL, "--colour", colour, "--snr", snr)
    assert json.loads(done("--json", *words).stdout)["snr"] == pytest.approx(snr, rel=1e-6)
    assert brightness(load_set(surfaces)).snr == pytest.approx(snr, rel=0.1)
    truth = ["truth/true_depth_mm.tiff", "truth/true_picture.tiff"]
    assert set(files_in(surfaces)) == FILES | set(truth)
    assert read_record(surfaces, "provenance.json")["options"]["objects"] == "surfaces"
    stated = read_record(surfaces, "truth.json")
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


def test_set_of_surfaces_has_no_metrics_of_planes(tmp_path: Path, done: Command) -> None:
    folder, out = tmp_path / "set", tmp_path / "planes"
    done("simulate", folder, "--objects", "surfaces", *SMALL)
    done("reconstruct", folder, "--depth-mm", 600, "--method", "backprojection", "--out", out)
    assert (out / "report.html").is_file()
    assert not (out / "metrics.json").exists()
    outside = read_record(folder, "truth.json")
    outside["surface"]["depth_mm"] = "../elsewhere.tiff"
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "truth.json").write_text(json.dumps(outside))
    with pytest.raises(InputError, match="elsewhere"):
        read_truth(tmp_path / "outside")
