"""`reconstruct`: the files and fields it promises, and how right its planes are on a small simulated scene."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import grey_levels, white_level
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.recon.solver.penalties import total_variation
from tests.pipelines.conftest import Command, Edit, assert_refused, run_undrawn
from tests.pipelines.forms import read_record

DEPTHS = ("--depth-mm", 500, "--depth-mm", 700)
ONE_STEP_LATE = ("--method", "pmlem-osl", "--penalty-weight")
METHODS = ("backprojection", "mlem", "pmlem-osl", "pmlem")


@pytest.fixture(scope="module")
def results(dark_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both planes of the larger scene by every method, to be read only."""
    out = tmp_path_factory.mktemp("results") / "planes"
    methods = (word for name in METHODS for word in ("--method", name))
    run_undrawn("reconstruct", dark_scene, "--out", out, *DEPTHS, "--prior", "tv", *methods)
    return out


def test_results_and_inputs_of_methods_are_recorded(results: Path, dark_scene: Path) -> None:
    planes = {f"plane_{depth}.{suffix}" for depth in ("00500.0", "00700.0") for suffix in ("tiff", "png", "json")}
    own = {f"{method}/{name}" for method in METHODS for name in (*planes, "reconstruction.json")}
    overview = {"overview.json", "integral_image.png", "reference_view.png", "noise_reference.png"}
    names = {str(path.relative_to(results)) for path in results.rglob("*") if path.is_file()}
    assert names == own | overview | {"report.html", "metrics.json"}
    views = {f"view_r{row}_c{column}.tiff" for row in range(5) for column in range(5)}
    for method in METHODS:
        record = read_record(results / method)
        assert [plane["depth_mm"] for plane in record["planes"] if plane["method"] == method] == [500.0, 700.0]
        assert (record["format"], record["command"], record["focus"]) == (1, "reconstruct", None)
        assert (record["options"]["method"], record["options"]["depth_mm"]) == (method, [500.0, 700.0])
        assert set(record["inputs"]) == views | {"elemental.toml", "flat.tiff"}
        for name, digest in record["inputs"].items():
            assert digest == hashlib.sha256((dark_scene / name).read_bytes()).hexdigest()
        assert set(record["versions"]) >= {"python", "faintfield", "numpy", "scipy", "numba"}
        assert record["wall_time_s"] > 0


@pytest.mark.parametrize("method", METHODS)
def test_record_of_plane_agrees_with_its_file(method: str, results: Path, dark_scene: Path) -> None:
    elemental_set = load_set(dark_scene)
    camera, (layout,) = elemental_set.settings.camera, channel_layouts(elemental_set)
    images = load_channel(elemental_set, layout)
    for plane in read_record(results / method)["planes"]:
        path = results / method / plane["file"]
        pixels = tifffile.imread(path)
        assert pixels.dtype == np.float32
        assert list(pixels.shape) == plane["shape"] == [72, 96]
        assert plane["channel"] == "grey"
        pitch_mm = plane["depth_mm"] / camera.fx_px
        assert plane["pitch_mm"] == pytest.approx(pitch_mm, rel=1e-12)
        np.testing.assert_allclose(plane["origin_mm"], [-camera.cx_px * pitch_mm, -camera.cy_px * pitch_mm], rtol=1e-12)
        assert plane["mean_e"] == pytest.approx(pixels.mean(dtype=float), rel=1e-6)
        # A default sample is a pixel of the reference view: the flux is their sum
        assert plane["flux_e"] == pytest.approx(pixels.sum(dtype=float), rel=1e-6)
        with tifffile.TiffFile(path) as file:
            tags = file.pages.first.tags
            assert tags["ResolutionUnit"].value == tifffile.RESUNIT.CENTIMETER
            assert tags["YResolution"].value == tags["XResolution"].value
            assert 10.0 / np.divide(*tags["XResolution"].value) == pytest.approx(pitch_mm, rel=1e-6)
        if method in ("mlem", "pmlem-osl"):
            grid = plane_grid(elemental_set, plane["depth_mm"])
            operator = OperatorFactory(elemental_set, layout, images).at(plane["depth_mm"], grid)
            penalty = plane["penalty_weight"] * total_variation(pixels, plane["epsilon_e2"])
            likelihood = operator.negative_log_likelihood(pixels, images)
            assert plane["objective"] == pytest.approx(likelihood + penalty, rel=1e-9)
            assert (penalty > 50) == (method == "pmlem-osl")


def test_pmlem_has_certificate_and_weight_curve(results: Path) -> None:
    for plane in read_record(results / "pmlem")["planes"]:
        certificate = plane["certificate"]
        assert certificate["reached"]
        assert 0 < certificate["value"] <= certificate["tolerance"] == 0.01
        assert certificate["passes"] == plane["passes"] <= 5
        assert plane["likelihood"] == "shifted-poisson"
        assert plane["penalty"] == {"name": "tv", "smoothing_e": 0.0}
        assert plane["penalty_weight_chosen"] == "predicts held-out views best"
        curve = plane["penalty_weight_curve"]
        weights = [point["weight"] for point in curve]
        best = min(curve, key=lambda point: point["held_out"])["weight"]
        assert weights == sorted(weights)
        assert min(weights) < best < max(weights)
        assert best / 1.2 <= plane["penalty_weight"] <= best * 1.2
        assert plane["passes_before"] < 40 * 7


@pytest.mark.parametrize(
    ("penalty", "likelihood"),
    [("quadratic", "poisson-gaussian"), ("none", "poisson-gaussian"), ("tv", "least-squares")],
)
def test_likelihoods_and_penalties_can_be_chosen(
    simulated_scene: Path, tmp_path: Path, done: Command, penalty: str, likelihood: str
) -> None:
    words = ("--depth-mm", 500, "--prior", "tv", "--penalty", penalty, "--likelihood", likelihood, "--passes", 3)
    done("reconstruct", simulated_scene, "--out", tmp_path / "out", *words)
    (plane,) = read_record(tmp_path / "out")["planes"]
    assert (plane["penalty"]["name"], plane["likelihood"]) == (penalty, likelihood)
    pixels = tifffile.imread(tmp_path / "out" / plane["file"])
    assert np.isfinite(pixels).all()
    assert pixels.min() >= 0
    assert (plane["penalty_weight"] > 0) == (penalty != "none")


def test_options_take_effect_and_are_recorded(scene: Path, tmp_path: Path, done: Command) -> None:
    options = ("--penalty-weight", 0.25, "--passes", 3, "--pitch-mm", 10)
    done("reconstruct", scene, "--out", tmp_path / "out", "--depth-mm", 500, *options)
    record = read_record(tmp_path / "out")
    (plane,) = record["planes"]
    assert (plane["penalty_weight"], plane["penalty_weight_chosen"]) == (0.25, "given")
    assert plane["passes"] <= 3
    assert plane["pitch_mm"] == 10.0
    assert plane["shape"] == [30, 40]  # 500 mm away 96 px of 120 px focal length span 400 mm
    samples_per_px = (10.0 / (500.0 / 120.0)) ** 2
    total = tifffile.imread(tmp_path / "out" / plane["file"]).sum(dtype=float)
    assert plane["flux_e"] == pytest.approx(total * samples_per_px, rel=1e-6)
    stated = {"method": "pmlem", "depth_mm": [500.0], "penalty_weight": 0.25, "passes": 3, "pitch_mm": 10.0}
    assert stated.items() <= record["options"].items()


def test_penalised_planes_have_a_third_of_the_error(results: Path) -> None:
    metrics = json.loads((results / "metrics.json").read_text())
    errors = {(row["method"], row["depth_mm"]): row["mse_bright"] for row in metrics["planes"]}
    assert set(errors) == {(method, depth) for method in METHODS for depth in (500.0, 700.0)}
    for (method, depth), error in errors.items():
        if method.startswith("pmlem"):
            assert error < min(errors["backprojection", depth] / 3, 0.04)  # 25 views instead of 49


def test_errors_refer_to_noise_free_plane_and_texture(
    results: Path, dark_scene: Path, tmp_path: Path, done: Command
) -> None:
    noise_free = dark_scene / "noise_free"
    done("reconstruct", noise_free, "--out", tmp_path / "bright", *DEPTHS, "--method", "backprojection")
    metrics = json.loads((results / "metrics.json").read_text())
    for row in metrics["planes"]:
        name = f"{row['depth_mm']:07.1f}"
        plane = tifffile.imread(results / row["method"] / f"plane_{name}.tiff")
        visible = read_frame(dark_scene / "truth" / f"visible_{name}.png").pixels_dn > 127
        against = {
            "mse_bright": tifffile.imread(tmp_path / "bright" / f"plane_{name}.tiff"),
            "mse_texture": tifffile.imread(dark_scene / "truth" / f"plane_{name}.tiff"),
        }
        for key, truth in against.items():
            error = np.mean(((plane - truth)[visible] / truth[visible].max()) ** 2, dtype=float)
            assert row[key] == pytest.approx(error, rel=1e-5)
        assert row["psnr_db"] == pytest.approx(-10 * np.log10(row["mse_bright"]), rel=1e-9)
        assert (row["object"], row["poses"]) == ({500.0: "truck", 700.0: "airplane"}[row["depth_mm"]], "true")
    assert metrics["snr"]["asked"] == pytest.approx(0.16)
    assert metrics["photons_per_px"]["linear"] == pytest.approx(3.84)


def test_errors_of_earlier_planes_do_not_stay(scene: Path, tmp_path: Path, done: Command) -> None:
    out = tmp_path / "out"
    words = ("reconstruct", scene, "--out", out, "--method", "backprojection", "--depth-mm")
    done(*words, 500, "--sweep-mm", "500:600:2", "--depth-mm", 500)
    assert [plane["depth_mm"] for plane in read_record(out)["planes"]] == [500.0, 600.0], "no depth twice"
    assert (out / "metrics.json").is_file()
    done(*words, 600)
    assert not (out / "metrics.json").exists()
    assert "Errors against the truth" not in (out / "report.html").read_text()


def test_colour_set_gives_colour_planes(colour_set: Path, tmp_path: Path, done: Command) -> None:
    done("reconstruct", colour_set, "--out", tmp_path / "out", "--depth-mm", 500, "--method", "backprojection")
    plane = tifffile.imread(tmp_path / "out" / "plane_00500.0.tiff")
    assert plane.shape == (48, 64, 3)
    records = read_record(tmp_path / "out")["planes"]
    assert [record["channel"] for record in records] == ["red", "green", "blue"]
    for index, record in enumerate(records):
        assert record["mean_e"] == pytest.approx(plane[:, :, index].mean(dtype=float), rel=1e-5)
    texture = tifffile.imread(colour_set / "truth" / "plane_00500.0.tiff")
    visible = read_frame(colour_set / "truth" / "visible_00500.0.png").pixels_dn > 127
    for index in range(3):
        # Its own colour is nearer than those of the others, whose light it does not see
        nearest = [np.corrcoef(plane[visible][:, index], texture[visible][:, other])[0, 1] for other in range(3)]
        assert int(np.argmax(nearest)) == index
    (row,) = json.loads((tmp_path / "out" / "metrics.json").read_text())["planes"]
    assert row["mse_bright"] < 0.05
    preview = read_frame(tmp_path / "out" / "plane_00500.0.png").pixels_dn
    np.testing.assert_array_equal(preview, grey_levels(plane, white_level(plane)))


def test_oscillation_is_reported(scene: Path, tmp_path: Path, done: Command) -> None:
    ended = done("reconstruct", scene, "--out", tmp_path / "out", "--depth-mm", 500, *ONE_STEP_LATE, 0.6)
    (plane,) = read_record(tmp_path / "out")["planes"]
    assert plane["certificate"]["oscillates"]
    assert not plane["certificate"]["settled"]
    assert "does not settle on 1 of 1 planes" in ended.stderr
    assert "does not settle" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ((), 2, "no plane is asked for"),
        (("--depth-mm", 500, "--likelihood", "least-squares", "--method", "mlem"), 2, "least squares has ratios below"),
        (("--sweep-mm", "100:100:64"), 2, "--sweep-mm 100:100:64: is no sweep; give two different ends"),
        (("--sweep-mm", "400:900:100000000000"), 2, "2 to 10000 planes"),
        (("--sweep-mm", "500:500.3:7"), 2, "would share a file name; keep them 0.1 mm apart"),
        (("--depth-mm", -500), 1, "GeometryMismatch: a plane at -500.0 mm is not in front of the camera"),
        (("--depth-mm", "nan"), 1, "GeometryMismatch: a plane at nan mm is not in front"),
        (("--depth-mm", 500, "--pitch-mm", 900), 1, "GeometryMismatch: plane at 500 mm: a plane needs at least 2 x 2"),
        (("--depth-mm", 500, "--pitch-mm", 1e-5), 1, "DiskFull: "),
        (("--depth-mm", 500, *ONE_STEP_LATE, 50), 1, "NotConverged: penalty weight 50 makes most denominators"),
        (("--disparity-px", 3), 1, "BadValue: no plane in front of the cameras has a disparity of 3 px"),
    ],
)
def test_impossible_planes_are_refused_before_writing(
    words: tuple[object, ...], code: int, message: str, simulated_scene: Path, tmp_path: Path, faintfield: Command
) -> None:
    ended = faintfield("reconstruct", simulated_scene, "--out", tmp_path / "out", *words)
    assert (ended.returncode, ended.stdout, len(ended.stderr.splitlines())) == (code, "", 1)
    assert message in ended.stderr
    assert not list(tmp_path.iterdir())


def test_plane_without_light_is_called_black(scene: Path, edit: Edit, tmp_path: Path, done: Command) -> None:
    edit(scene, lambda settings: settings["noise"].update(offset_dn=200.0))
    for method in ("pmlem", "joint"):
        words = ("--out", tmp_path / method, "--depth-mm", 500, "--method", method, "--prior", "tv")
        assert "1 of 1 planes are black" in done("reconstruct", scene, *words).stderr
        assert read_frame(tmp_path / method / "plane_00500.0.tiff").pixels_dn.max() < 1e-4


@pytest.mark.parametrize(
    "words", ["reconstruct {}", "reconstruct {} --out {out}", "darken {} {out}", "export colmap {} {out}"]
)
def test_folders_that_are_no_sets_are_named(words: str, tmp_path: Path, faintfield: Command) -> None:
    pictures, options = tmp_path / "pictures", ["--depth", "auto"] if "reconstruct" in words else []
    pictures.mkdir()
    (pictures / "view.png").touch()
    for folder, message in (
        (tmp_path / "absent", "absent: no such folder; name a session, or a folder with elemental.toml"),
        (pictures, "is a folder of pictures (view.png), no set; make a set of them first by `faintfield import grid "),
    ):
        ended = faintfield(*words.format(folder, out=tmp_path / "out").split(), *options)
        assert_refused(ended, "MissingFile", message)


def test_absent_folder_is_named_before_missing_depths(tmp_path: Path, faintfield: Command) -> None:
    assert_refused(faintfield("reconstruct", tmp_path / "absent"), "MissingFile", "absent: no such folder")


def test_room_for_all_of_a_sweep_is_needed(
    sweep: Path, simulated_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, faintfield: Command
) -> None:
    out = Path(shutil.copytree(sweep, tmp_path / "out"))
    planes, stack = ([path.stat().st_size for path in sweep.glob(name)] for name in ("plane_*.tiff", "stack.tiff"))
    words = ("reconstruct", simulated_scene, "--sweep-mm", "500:700:5", "--method", "backprojection", "--out")
    # A quarter is for decoded frames
    monkeypatch.setattr("faintfield.pipelines.formats.files._free_bytes", lambda _: 1.25 * sum(planes + stack))
    assert_refused(faintfield(*words, tmp_path / "new"), "DiskFull", "MB are needed")
    assert faintfield(*words, out).returncode == 0  # the planes are there
