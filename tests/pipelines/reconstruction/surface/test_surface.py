"""`reconstruct --surface`: files that are made, kept and made again, refusals, and pictures by `--prior`."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

import faintfield
from faintfield.pipelines.formats import frames as frames_module
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.reconstruction.planes import prior as prior_module
from faintfield.pipelines.reconstruction.surface import files as surface_files
from faintfield.pipelines.reconstruction.surface import reconstruct as surface
from faintfield.recon.surface.goodness import Prediction
from tests.pipelines.conftest import SMALL, Command, Edit, assert_refused, run_undrawn
from tests.pipelines.forms import GOLDEN, check_proposal, files_in, flip_last_bit, form_of_result, read_record
from tests.pipelines.surfaces import FOUND_CONFIDENCE, FOUND_MM, Searches, found_at_once

RANGE = ("--depth-range-mm", "400:900")
FAST = (*RANGE, "--penalty-weight", 0.5, "--passes", 2)


def test_second_call_keeps_files_and_prints_same_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: Command
) -> None:
    """A scene of surfaces, with nothing replaced in the first call."""
    folder, out = tmp_path / "set", tmp_path / "out"
    done("simulate", folder, "--objects", "surfaces", "--snr", 4, "--size-px", 64, 48, *SMALL[3:])
    done("reconstruct", folder, "--surface", *RANGE, "--out", out)
    before = files_in(out, "report.html")
    (out / ".picture.tiff.0123abcd.unfinished").write_bytes(b"left by a command that was killed")

    decoded = vars(frames_module)["_decoded"]

    def refuse(file: Any, path: Path, *rest: Any) -> Any:
        assert path.parent == out, f"{path} is decoded"
        return decoded(file, path, *rest)

    flat = read_frame(folder / "flat.tiff")
    monkeypatch.setattr(frames_module, "_decoded", refuse)
    monkeypatch.setattr("faintfield.pipelines.formats.sets.elemental_set.read_frame", lambda *_: flat)
    outcome = json.loads(done("reconstruct", folder, "--surface", *RANGE, "--out", out, "--json").stdout)
    assert form_of_result(out / "surface.json") == form_of_result(GOLDEN / "surface_set.json")
    assert outcome["surface"] == read_record(out, "surface.json")["surface"]
    assert (outcome["planes"], outcome["report"]) == ([], str(out / "report.html"))
    assert files_in(out, "report.html") == before


def test_unexplained_surface_is_told_of_at_the_end(
    seen: Searches, scene: Path, monkeypatch: pytest.MonkeyPatch, done: Command
) -> None:
    prediction = Prediction(np.array([3]), 1000, surface=2045.0, planes=2050.0, standard_error=1.0, neighbours=3000.0)
    monkeypatch.setattr(
        "faintfield.pipelines.reconstruction.depth.search.estimate_surface",
        lambda views, *_: replace(found_at_once(views), prediction=prediction),
    )
    told = done("reconstruct", scene, "--surface", *FAST, "--out", scene / "out", "--json")
    warning = json.loads(told.stdout)["surface_warning"]
    assert warning.startswith("This surface does not explain its views")
    assert told.stderr.splitlines()[-1].endswith(warning)
    assert "SNR of a view" in (scene / "out" / "report.html").read_text()
    assert read_record(scene / "out", "overview.json")["brightness"]["snr"] is not None


@pytest.mark.parametrize(
    ("confidence", "spacing", "remark"),
    [
        (0.5, 1.0, "No depth of this surface is sure: do not measure in it; use more light"),
        (
            0.5,
            1.61,
            "No depth of this surface is sure: do not measure in it; its nodes are too close",
        ),
        (0.95, 1.0, None),
    ],
)
def test_surface_without_sure_depths_says_so(
    confidence: float,
    spacing: float,
    remark: str | None,
    seen: Searches,
    scene: Path,
    monkeypatch: pytest.MonkeyPatch,
    done: Command,
) -> None:
    monkeypatch.setattr("tests.pipelines.surfaces.FOUND_CONFIDENCE", confidence)
    monkeypatch.setattr("tests.pipelines.surfaces.FOUND_SPACING", spacing)
    last = done("reconstruct", scene, "--surface", *FAST, "--out", scene / "out").stderr.splitlines()[-1]
    shown = "depth of this surface is sure" in (scene / "out" / "report.html").read_text()
    assert (last.startswith(remark or "a surface in"), shown) == (True, remark is not None), last
    assert (remark or "% of the depths sure>") in repr(faintfield.open(scene / "out"))


def test_maps_follow_from_depth_and_confidence(seen: Searches, scene: Path, done: Command) -> None:
    out = scene / "out"
    done("reconstruct", scene, "--surface", *FAST, "--out", out)
    np.testing.assert_allclose(tifffile.imread(out / "depth_mm.tiff"), FOUND_MM, rtol=1e-6)
    # Half of a normal distribution lies within 0.6745 σ, and here within 2 %
    np.testing.assert_allclose(tifffile.imread(out / "depth_sigma_mm.tiff"), 0.02 * FOUND_MM / 0.67449, rtol=1e-4)
    np.testing.assert_allclose(tifffile.imread(out / "depth_confidence.tiff"), FOUND_CONFIDENCE)
    surface_record = read_record(out, "surface.json")["surface"]
    assert (surface_record["known_share"], surface_record["sure_share"], surface_record["held_out"]) == (1, 0, None)
    assert surface_record["searched"] == pytest.approx([400, 900])
    assert len(seen) == 1
    # The nodes are 50 mm apart and f is 120 px: 10 px at 600 mm, up to the errors of the simulated poses
    done("reconstruct", scene, "--surface", "--disparity-range-px=-15:-5", *FAST[2:], "--out", out)
    surface_record = read_record(out, "surface.json")["surface"]
    np.testing.assert_allclose(tifffile.imread(out / "disparity_px.tiff"), -10, rtol=0.03)
    assert surface_record["searched"] == pytest.approx([-15, -5])
    assert (surface_record["unit"], surface_record["points"]) == ("px", None)
    assert not [path for path in out.iterdir() if "_mm" in path.name or path.suffix == ".ply"], "the earlier unit"


def test_other_options_pixels_or_damage_make_it_again(seen: Searches, scene: Path, done: Command) -> None:
    call = ("reconstruct", scene, "--out", scene / "out", "--surface", *FAST[2:], "--depth-range-mm", "400:1000")
    done(*call)
    done(*call[:-1], "1000:400")
    assert len(seen) == 1
    done(*call, "--penalty", "none")
    done(*call)
    assert len(seen) == 3
    picture = (scene / "out" / "picture.tiff").read_bytes()
    flip_last_bit(scene / "out" / "picture.tiff")
    assert "picture.tiff was altered; it is made again" in done(*call).stderr
    assert (scene / "out" / "picture.tiff").read_bytes() == picture
    pixels = read_frame(scene / "view_r0_c0.tiff").pixels_dn.copy()
    pixels[3, 4] += 1
    write_frame(scene / "view_r0_c0.tiff", pixels)
    done(*call)
    assert len(seen) == 5


@pytest.mark.parametrize(
    ("module", "name", "survives"), [(surface, "load_channel", True), (surface_files, "write_record", False)]
)
def test_interrupted_surface_is_whole_or_absent(
    module: Any, name: str, survives: bool, seen: Searches, scene: Path,
    monkeypatch: pytest.MonkeyPatch, faintfield: Command, done: Command,
) -> None:  # fmt: skip
    out, again = scene / "out", ("--depth-range-mm", "400:950", *FAST[2:])
    done("reconstruct", scene, "--surface", *FAST, "--out", out)

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module, name, interrupt)
        assert faintfield("reconstruct", scene, "--surface", *again, "--out", out).returncode == 1
    assert (out / "surface.json").exists() == (out / "report.html").exists() == survives
    if survives:
        done("verify", out)
    assert not list(out.glob(".*"))
    done("reconstruct", scene, "--surface", *again, "--out", out)
    done("verify", out, "--inputs", scene)
    assert read_record(out, "surface.json")["options"]["depth_range_mm"] == [400, 950]


def test_planes_and_surface_are_shown_on_one_page(seen: Searches, scene: Path, done: Command) -> None:
    done("reconstruct", scene, "--surface", *FAST, "--out", scene / "out")
    done("reconstruct", scene, "--depth-mm", 500, "--method", "backprojection", "--out", scene / "out")
    done("verify", scene / "out", "--inputs", scene)
    done("reconstruct", scene, "--surface", *FAST, "--out", scene / "out")
    assert len(seen) == 1
    page = (scene / "out" / "report.html").read_text()
    assert 'id="surface"' in page
    assert "500 mm" in page


def test_depth_map_and_surface_refuse_each_other(
    seen: Searches, scene: Path, faintfield: Command, done: Command
) -> None:
    sweep = ("--sweep-mm", "400:800:5", "--method", "backprojection", "--depth-map")
    for first, second in ((("--surface", *FAST), sweep), (sweep, ("--surface", *FAST))):
        out = scene / first[0].strip("-")
        done("reconstruct", scene, *first, "--out", out)
        before = {path.name for path in out.iterdir()}
        refused = faintfield("reconstruct", scene, *second, "--out", out)
        assert_refused(refused, "OutputExists", "give another --out")
        assert {path.name for path in out.iterdir()} == before
        done("verify", out)


def test_full_disk_is_said_before_view_is_read(
    seen: Searches, scene: Path, monkeypatch: pytest.MonkeyPatch, faintfield: Command
) -> None:
    free = shutil.disk_usage(scene)._replace(free=10_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: free)
    ended = faintfield("reconstruct", scene, "--surface", *FAST, "--out", scene / "out")
    assert_refused(ended, "DiskFull", "10.0 MB are free")
    assert (seen, (scene / "out").exists()) == ([], False)


PROPOSED = {f"picture_{name}{suffix}" for name in ("proposal", "moved") for suffix in (".tiff", ".png")}


def _map(folder: Path, name: str = "picture") -> NDArray[np.float32]:
    return np.asarray(tifffile.imread(folder / f"{name}.tiff"))


def test_default_picture_is_total_variation_with_detail(
    seen: Searches, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: Command
) -> None:
    monkeypatch.setattr(surface, "refined", lambda operator, images, plane: plane + np.float32(1))
    done("reconstruct", scene, "--surface", *FAST, "--out", tmp_path / "default")
    done("reconstruct", scene, "--surface", *FAST, "--prior", "tv", "--out", tmp_path / "tv")
    np.testing.assert_array_equal(_map(tmp_path / "default"), _map(tmp_path / "tv") + np.float32(1))
    default, tv = read_record(tmp_path / "default", "surface.json"), read_record(tmp_path / "tv", "surface.json")
    assert tv["options"] == default["options"] | {"prior": "tv"}
    assert not {"prior", "proposal"} & {*default["options"], *default["surface"]["channels"][0]}
    assert set(default["sha256"]) == set(tv["sha256"])


def test_surface_at_one_depth_equals_the_plane(seen: Searches, scene: Path, tmp_path: Path, done: Command) -> None:
    words = ("reconstruct", scene, "--penalty-weight", 0.5, "--prior", "tv", "--out")
    done(*words, tmp_path / "surface", "--surface", *RANGE)
    done(*words, tmp_path / "plane", "--depth-mm", FOUND_MM)
    found, plane = _map(tmp_path / "surface"), _map(tmp_path / "plane", f"plane_{FOUND_MM:07.1f}")
    (channel,) = read_record(tmp_path / "surface", "surface.json")["surface"]["channels"]
    assert channel["certificate"]["reached"]
    # Both are certified to 1 % of the same optimum
    assert np.linalg.norm(found - plane) < 0.02 * np.linalg.norm(plane)


def test_proposal_and_change_are_written_beside_picture(
    seen: Searches, scene: Path, tmp_path: Path, done: Command
) -> None:
    call = ("reconstruct", scene, "--surface", *FAST, "--prior", "patches")
    done(*call, "--proposal", "--out", tmp_path / "out")
    picture, proposal, moved = (_map(tmp_path / "out", f"picture{name}") for name in ("", "_proposal", "_moved"))
    record = read_record(tmp_path / "out", "surface.json")
    (channel,) = record["surface"]["channels"]
    assert channel["prior"]["name"] == "patches"
    check_proposal(picture, proposal, moved, channel["prior"]["moved_sigma"])
    assert channel["mean_e"] == pytest.approx(picture.mean(dtype=float), rel=1e-6)
    assert (record["options"]["prior"], record["options"]["proposal"]) == ("patches", True)
    assert set(record["sha256"]) >= PROPOSED
    done("verify", tmp_path / "out", "--inputs", scene)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "patches; the data moved it by" in page
    assert "What the prior proposed" in page
    done(*call, "--out", tmp_path / "out")
    assert not PROPOSED & {path.name for path in (tmp_path / "out").iterdir()}, "files of the earlier surface"
    np.testing.assert_array_equal(_map(tmp_path / "out"), picture)
    done("verify", tmp_path / "out")


def test_each_colour_has_prior_of_its_own(
    seen: Searches, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: Command
) -> None:
    monkeypatch.setattr(prior_module, "patch_candidates", lambda evidence, names=None: {"pilot": evidence.pilot})
    for path in [*scene.glob("view_*.tiff"), scene / "noise_reference.tiff"]:
        grey = read_frame(path).pixels_dn
        write_frame(path, np.stack([grey, grey // 2 + 50, grey], axis=-1))
    weak = (*RANGE, "--penalty-weight", 0.1, "--passes", 2)  # so that the data move the pictures
    done("reconstruct", scene, "--surface", *weak, "--prior", "patches", "--proposal", "--out", tmp_path)
    red, green, blue = (channel["prior"] for channel in read_record(tmp_path, "surface.json")["surface"]["channels"])
    assert red == blue != green
    assert _map(tmp_path, "picture_moved").shape == _map(tmp_path).shape == (72, 96, 3)


def test_too_few_views_give_picture_of_total_variation(
    seen: Searches, scene: Path, edit: Edit, tmp_path: Path, done: Command
) -> None:
    def four_views(settings: dict[str, Any]) -> None:
        settings.update(view=[settings["view"][index] for index in (4, 1, 3, 5)], reference_view=0)
        settings["view"][1].update(rt_cam_ref=[0.0, 3.0, 0.0, 50.0, 50.0, 0.0])  # sees nothing

    edit(scene, four_views)
    done("reconstruct", scene, "--surface", *FAST, "--prior", "tv", "--out", tmp_path / "tv")
    done("reconstruct", scene, "--surface", *FAST, "--prior", "patches", "--proposal", "--out", tmp_path / "patches")
    (channel,) = read_record(tmp_path / "patches", "surface.json")["surface"]["channels"]
    assert channel["prior"] == {"name": "tv", "left_out": "too few views to hold some out"}
    assert not PROPOSED & {path.name for path in (tmp_path / "patches").iterdir()}
    np.testing.assert_array_equal(_map(tmp_path / "patches"), _map(tmp_path / "tv"))
    assert "tv: too few views to hold some out" in (tmp_path / "patches" / "report.html").read_text()


@pytest.mark.deep
@pytest.mark.parametrize("snr", [0.16, 1])
def test_on_depths_that_are_found_prior_lowers_error(snr: float, tmp_path: Path) -> None:
    small = ("--size-px", 160, 120, "--rows", 5, "--columns", 5, "--snr", snr)
    run_undrawn("simulate", tmp_path / "set", "--objects", "surfaces", *small)
    truth = tifffile.imread(tmp_path / "set" / "truth" / "true_picture.tiff")
    errors = []
    for prior in ("tv", "auto"):
        words = ("--surface", "--depth-range-mm", "450:1200", "--prior", prior, "--out", tmp_path / prior)
        run_undrawn("reconstruct", tmp_path / "set", *words)
        errors.append(np.mean(np.square(_map(tmp_path / prior) - truth)))
    assert errors[1] < 0.94 * errors[0]
