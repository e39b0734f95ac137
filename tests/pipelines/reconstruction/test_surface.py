"""`reconstruct --surface`: what it makes, keeps and makes again, and what it refuses."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats import frames as frames_module
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.reconstruction import surface, surface_files
from tests.pipelines.conftest import Command
from tests.pipelines.formats.results.test_golden import GOLDEN
from tests.pipelines.forms import form_of_result, read_record
from tests.pipelines.surfaces import FOUND_CONFIDENCE, FOUND_MM, Searches

pytestmark = pytest.mark.usefixtures("undrawn")


RANGE = ("--depth-range-mm", "400:900")
FAST = (*RANGE, "--penalty-weight", 0.5, "--passes", 2)


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A scene of surfaces, and what is made of it with nothing replaced; to be read only."""
    folder = tmp_path_factory.mktemp("real")
    small = ("--size-px", "96", "72", "--rows", "3", "--columns", "3", "--snr", "4")
    assert run(["simulate", str(folder / "set"), "--objects", "surfaces", *small]) == 0
    assert run(["reconstruct", str(folder / "set"), "--surface", *RANGE, "--out", str(folder / "out")]) == 0
    return folder / "set", folder / "out"


def test_new_surface_has_form_of_golden_one(real: tuple[Path, Path]) -> None:
    assert form_of_result(real[1] / "surface.json") == form_of_result(GOLDEN / "surface_set.json")


def test_second_call_keeps_files_and_prints_same_record(
    real: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: Command
) -> None:
    out = Path(shutil.copytree(real[1], tmp_path / "out"))
    (out / ".picture.tiff.0123abcd.unfinished").write_bytes(b"left by a command that was killed")
    before = {path.name: path.read_bytes() for path in real[1].iterdir() if path.name != "report.html"}

    def refuse(file: object, path: Path, *_: object) -> None:
        raise AssertionError(f"{path} is decoded")

    flat = read_frame(real[0] / "flat.tiff")
    monkeypatch.setattr(frames_module, "_decoded", refuse)
    monkeypatch.setattr("faintfield.pipelines.formats.sets.elemental_set.read_frame", lambda *_: flat)
    outcome = json.loads(done("reconstruct", real[0], "--surface", *RANGE, "--out", out, "--json").stdout)
    assert outcome["surface"] == read_record(real[1], "surface.json")["surface"]
    assert (outcome["planes"], outcome["report"]) == ([], str(out / "report.html"))
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.name != "report.html"} == before


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


def test_disparities_are_those_of_nodes(seen: Searches, scene: Path, done: Command) -> None:
    """The nodes are 50 mm apart and f is 120 px: 10 px at 600 mm, up to the errors of the simulated poses."""
    done("reconstruct", scene, "--surface", *FAST, "--out", scene / "out")
    options = ("--disparity-range-px=-15:-5", *FAST[2:])
    done("reconstruct", scene, "--surface", *options, "--out", scene / "out")
    record = read_record(scene / "out", "surface.json")["surface"]
    np.testing.assert_allclose(tifffile.imread(scene / "out" / "disparity_px.tiff"), -10, rtol=0.03)
    assert record["searched"] == pytest.approx([-15, -5])
    assert (record["unit"], record["points"]) == ("px", None)
    left = {path.name for path in (scene / "out").glob("*") if "_mm" in path.name or path.suffix == ".ply"}
    assert left == set(), "files of the earlier unit"


def test_other_options_make_it_again(seen: Searches, scene: Path, done: Command) -> None:
    call = ("reconstruct", scene, "--out", scene / "out", "--surface", *FAST[2:], "--depth-range-mm")
    for words, searches in (
        (("400:900",), 1),
        (("900:400",), 1),
        (("400:1000",), 2),
        (("400:1000", "--penalty", "none"), 3),
    ):
        done(*call, *words)
        assert len(seen) == searches


def test_another_pixel_or_damaged_file_makes_it_again(seen: Searches, scene: Path, done: Command) -> None:
    call = ("reconstruct", scene, "--surface", *FAST, "--out", scene / "out")
    done(*call)
    picture = (scene / "out" / "picture.tiff").read_bytes()
    (scene / "out" / "picture.tiff").write_bytes(picture[:-1] + bytes([picture[-1] ^ 1]))
    assert "picture.tiff was altered; it is made again" in done(*call).stderr
    assert (scene / "out" / "picture.tiff").read_bytes() == picture
    pixels = read_frame(scene / "view_r0_c0.tiff").pixels_dn.copy()
    pixels[3, 4] += 1
    write_frame(scene / "view_r0_c0.tiff", pixels)
    done(*call)
    assert len(seen) == 3


class TestInterrupted:
    """An interrupt leaves an earlier surface whole, or nothing that vouches for anything."""

    @pytest.mark.parametrize(
        ("module", "name", "survives"), [(surface, "load_channel", True), (surface_files, "write_record", False)]
    )
    def test_at_any_stage(
        self, module: Any, name: str, survives: bool, seen: Searches, scene: Path,
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


class TestFolder:
    """A surface and other results in one folder."""

    def test_planes_and_surface_are_shown_on_one_page(self, seen: Searches, scene: Path, done: Command) -> None:
        done("reconstruct", scene, "--surface", *FAST, "--out", scene / "out")
        done("reconstruct", scene, "--depth-mm", 500, "--passes", 2, "--out", scene / "out")
        done("verify", scene / "out", "--inputs", scene)
        done("reconstruct", scene, "--surface", *FAST, "--out", scene / "out")
        assert len(seen) == 1
        page = (scene / "out" / "report.html").read_text()
        assert 'id="surface"' in page
        assert "500 mm" in page

    def test_depth_map_and_surface_refuse_each_other(
        self, seen: Searches, scene: Path, faintfield: Command, done: Command
    ) -> None:
        sweep = ("--sweep-mm", "400:800:5", "--method", "backprojection", "--depth-map")
        for first, second in ((("--surface", *FAST), sweep), (sweep, ("--surface", *FAST))):
            out = scene / first[0].strip("-")
            done("reconstruct", scene, *first, "--out", out)
            before = {path.name for path in out.iterdir()}
            refused = faintfield("reconstruct", scene, *second, "--out", out)
            assert refused.returncode == 1
            assert "OutputExists" in refused.stderr
            assert "give another --out" in refused.stderr
            assert {path.name for path in out.iterdir()} == before
            done("verify", out)

    def test_full_disk_is_said_before_view_is_read(
        self, seen: Searches, scene: Path, monkeypatch: pytest.MonkeyPatch, faintfield: Command
    ) -> None:
        free = shutil.disk_usage(scene)._replace(free=10_000_000)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: free)
        ended = faintfield("reconstruct", scene, "--surface", *FAST, "--out", scene / "out")
        assert ended.returncode == 1
        assert "DiskFull" in ended.stderr
        assert "10.0 MB are free" in ended.stderr
        assert (seen, (scene / "out").exists()) == ([], False)
