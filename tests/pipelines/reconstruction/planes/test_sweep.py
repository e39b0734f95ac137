"""Planes that are there stay, whatever ended the run that made them; what is made of something else is made anew."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from msgspec import UNSET, convert, structs

from faintfield.pipelines.formats.files import UNFINISHED, shared
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.plane_files import PARTS, PlaneFiles
from faintfield.pipelines.formats.results.records import FocusPoint, PlaneRecord
from faintfield.pipelines.reconstruction.request import Request
from tests.pipelines.conftest import Command, assert_refused
from tests.pipelines.forms import files_in

SWEEP = ("--sweep-mm", "500:700:3", "--method", "backprojection")

# Runs a command and kills the process, as nothing can be caught, when it has flushed something for the n-th time.
_KILLED = """
import os, signal, sys
left, fsync = int(sys.argv[1]), os.fsync
def killing(descriptor):
    global left
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    fsync(descriptor)
os.fsync = killing
from faintfield.pipelines.cli import main
main(sys.argv[2:])
"""


def _contents(folder: Path) -> dict[str, bytes]:
    """Return all files but for what they say of times: of the page, and of the wall time."""
    found = files_in(folder, "report.html")
    record = json.loads(found["reconstruction.json"])
    del record["wall_time_s"], record["record_sha256"]
    return found | {"reconstruction.json": json.dumps(record).encode()}


@pytest.mark.deep
@pytest.mark.parametrize("seed", [1, 2])
def test_killed_sweep_is_completed_alike(seed: int, colour_set: Path, tmp_path: Path, done: Command) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    done("reconstruct", colour_set, "--out", whole, *SWEEP)
    anywhere, in_a_file = np.random.default_rng(seed).integers(2, 9, 2) * 2  # of some 40; each file, then its folder
    moments = (anywhere, in_a_file - 1) if seed > 1 else (in_a_file - 1,)
    for moment in moments:
        words = map(str, ("reconstruct", colour_set, "--out", killed, *SWEEP))
        command = [sys.executable, "-c", _KILLED, str(moment), *words]
        ended = subprocess.run(command, env={**os.environ, "NUMBA_NUM_THREADS": "1"}, capture_output=True)
        assert ended.returncode == -9
        assert not (killed / "reconstruction.json").exists()
    assert list(killed.rglob(f"*{UNFINISHED}"))
    done("reconstruct", colour_set, "--out", killed, *SWEEP)
    assert _contents(killed) == _contents(whole)


def test_parts_are_put_together(colour_set: Path, tmp_path: Path, done: Command, faintfield: Command) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    done("reconstruct", colour_set, "--out", whole, *SWEEP)
    with shared(parts):  # as another part at the same time
        for part, names in (("2/2", [600]), ("1/2", [500, 600, 700])):
            done("reconstruct", colour_set, "--out", parts, *SWEEP, "--part", part)
            assert sorted(path.name for path in parts.glob("*.tiff")) == [f"plane_{mm:07.1f}.tiff" for mm in names]
        assert_refused(faintfield("reconstruct", colour_set, "--out", parts, *SWEEP), "OutputBusy")
    assert not (parts / "reconstruction.json").exists()
    assert "3 of 3 planes are there" in done("reconstruct", colour_set, "--out", parts, *SWEEP).stderr
    assert _contents(parts) == _contents(whole)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ((*SWEEP, "--part", "0/4"), "is no part I/N"),
        ((*SWEEP, "--part", "5/4"), "is no part I/N"),
        ((*SWEEP[:2], "--joint", "--part", "1/4"), "solves all planes together"),
        (("--surface", "--part", "1/4"), "makes one picture"),
    ],
)
def test_wrong_parts_are_refused(
    options: tuple[str, ...], reason: str, scene: Path, tmp_path: Path, faintfield: Command
) -> None:
    ended = faintfield("reconstruct", scene, "--out", tmp_path / "out", *options)
    assert ended.returncode == 2
    assert reason in ended.stderr


def test_only_altered_planes_are_made_again(scene: Path, tmp_path: Path, done: Command) -> None:
    out = tmp_path / "out"
    done("reconstruct", scene, "--out", out, *SWEEP)
    first = {path.name: path.stat().st_mtime_ns for path in out.glob("plane_*.tiff")}
    with (out / "plane_00600.0.tiff").open("r+b") as file:
        file.seek(-4, 2)
        file.write(b"\0\0\x80\x3f")
    again = _contents(out)
    done("reconstruct", scene, "--out", out, *SWEEP)
    assert [name for name, when in first.items() if (out / name).stat().st_mtime_ns != when] == ["plane_00600.0.tiff"]
    assert again["plane_00600.0.tiff"] != (out / "plane_00600.0.tiff").read_bytes()
    view = scene / "view_r0_c0.tiff"
    tifffile.imwrite(view, tifffile.imread(view) + np.uint16(1))
    assert "are there" not in done("reconstruct", scene, "--out", out, *SWEEP).stderr


def _files_of_a_colour_plane(folder: Path) -> tuple[PlaneFiles, PlaneRecord]:
    """Return where a plane of three colours goes, and the record of its first."""
    origin = provenance("reconstruct", Request([500.0], ["occlusion"]).options("occlusion", "stated"), {"view": "0"})
    files = PlaneFiles(folder, "occlusion", 500.0, ("red", "green", "blue"), origin)
    place = {"depth_mm": 500.0, "shape": (4, 5), "pitch_mm": 1.0, "origin_mm": (0.0, 0.0), "file": files.path.name}
    solution = {"penalty_weight_chosen": "given", "passes": 1, "mean_e": 1.0, "flux_e": 20.0}
    none = dict.fromkeys(("penalty_weight", "epsilon_e2", "objective", "certificate"))
    return files, convert({"method": "occlusion", "channel": "red", **place, **solution, **none}, PlaneRecord)


def test_only_files_that_all_colours_have_are_named(tmp_path: Path) -> None:
    files, record = _files_of_a_colour_plane(tmp_path)
    one = {"plane": np.ones((4, 5), np.float32)}
    files.save_part("red", one | {"sigma": one["plane"], "opacity": one["plane"]}, record, None)
    for colour in ("green", "blue"):
        files.save_part(colour, one | {"sigma": one["plane"]}, structs.replace(record, channel=colour), None)
    assert files.missing() == []
    for written in files.finish().planes:
        assert written.sigma_file == "plane_00500.0_sigma.tiff"
        assert written.opacity_file is UNSET
    assert sorted(path.name for path in tmp_path.glob("*.tiff")) == ["plane_00500.0.tiff", "plane_00500.0_sigma.tiff"]
    assert list((tmp_path / PARTS).iterdir()) == []


def test_altered_part_of_colour_plane_is_made_again(tmp_path: Path) -> None:
    files, record = _files_of_a_colour_plane(tmp_path)
    files.save_part("red", {"plane": np.arange(20, dtype=np.float32).reshape(4, 5)}, record, FocusPoint(2.0, 3.0))
    assert files.missing() == ["green", "blue"]
    for path in sorted((tmp_path / PARTS).iterdir()):
        whole = path.read_bytes()
        for place in range(0, len(whole), 7):
            path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
            assert files.missing() == ["red", "green", "blue"]
        path.unlink()
        os.mkfifo(path)
        assert files.missing() == ["red", "green", "blue"]
        path.unlink()
        path.write_bytes(whole)
    assert files.missing() == ["green", "blue"]


def test_what_killed_call_with_several_methods_left_goes(scene: Path, tmp_path: Path, done: Command) -> None:
    left = tmp_path / f".shared.1234{UNFINISHED}"
    left.mkdir()
    (left / "grey.float32").write_bytes(b"1234")
    done("reconstruct", scene, "--out", tmp_path, "--depth-mm", 500, "--method", "backprojection", "--method", "mlem")
    assert not left.exists()
