"""Bad input: a one-line named error, exit code 1, nothing on standard output, and nothing half-written."""

import os
import shutil
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from subprocess import run as run_process
from typing import Any

import numpy as np
import pytest
import tifffile
import tomli_w

from faintfield.pipelines.cli import run
from tests.patience import HANG_S

type Damage = Callable[[Path], object]


@pytest.fixture(scope="session")
def whole_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "set"
    assert run(["simulate", str(folder), "--size-px", "48", "36", "--rows", "3", "--columns", "3"]) == 0
    return folder


def _settings(how: Callable[[dict[str, Any]], object]) -> Damage:
    def damage(folder: Path) -> None:
        path = folder / "elemental.toml"
        settings = tomllib.loads(path.read_text())
        how(settings)
        path.write_text(tomli_w.dumps(settings))

    return damage


def _view(pixels: Any) -> Damage:
    return lambda folder: tifffile.imwrite(folder / "view_r2_c1.tiff", pixels)


def _content(name: str, content: Callable[[bytes], bytes]) -> Damage:
    def damage(folder: Path) -> None:
        path = folder / name
        path.write_bytes(content(path.read_bytes()))

    return damage


def _pipe(folder: Path) -> None:
    (folder / "view_r2_c1.tiff").unlink()
    os.mkfifo(folder / "view_r2_c1.tiff")


def _saturated_everywhere(settings: dict[str, Any]) -> None:
    settings["noise"]["saturation_dn"] = 1.0


DAMAGED: dict[str, tuple[Damage, str, str]] = {
    "missing view": (lambda folder: (folder / "view_r2_c1.tiff").unlink(), "MissingFile", "view_r2_c1.tiff is named"),
    "no set": (lambda folder: (folder / "elemental.toml").unlink(), "MissingFile", "elemental.toml: no such file"),
    "wrong size": (
        _view(np.zeros((36, 40), np.uint16)),
        "WrongSize",
        "view_r2_c1.tiff: is 40 x 36 px, the camera 48 x 36 px",
    ),
    "8 bits and a 16-bit noise model": (_view(np.zeros((36, 48), np.uint8)), "WrongBitDepth", "has 8 bits per pixel"),
    "pose that is no number": (
        _settings(lambda s: s["view"][7].update(rt_cam_ref=[float("nan")] * 6)),
        "BadValue",
        "view[7].rt_cam_ref[0] = nan",
    ),
    "unknown key": (
        _settings(lambda s: s["camera"].update(focal_px=3.0)),
        "UnknownKey",
        "'camera.focal_px' is not a key that is read",
    ),
    "all pixels saturated": (_settings(_saturated_everywhere), "GeometryMismatch", "sees the plane"),
    "blind pixels": (
        lambda folder: tifffile.imwrite(folder / "flat.tiff", np.zeros((36, 48), np.float32)),
        "GeometryMismatch",
        "sees the plane",
    ),
    "lens that folds the image": (
        _settings(lambda s: s["camera"].update(distortion=[-9.0])),
        "LensNotInvertible",
        "",
    ),
    "truncated view": (_content("view_r2_c1.tiff", lambda b: b[: len(b) // 2]), "UnreadableImage", "view_r2_c1.tiff"),
    "empty view": (_content("view_r2_c1.tiff", lambda b: b""), "UnreadableImage", "view_r2_c1.tiff"),
    "damaged first view": (_content("view_r0_c0.tiff", lambda b: b[:8]), "UnreadableImage", "view_r0_c0.tiff"),
    "detector larger than any": (
        _settings(lambda s: s["camera"].update(size_px=[200_000, 200_000])),
        "BadValue",
        "size_px is at most 65535 a side and 250 million pixels, got (200000, 200000)",
    ),
    "detector larger than the views": (
        _settings(lambda s: s["camera"].update(size_px=[15_000, 15_000])),
        "WrongSize",
        "is 48 x 36 px, the camera 15000 x 15000 px",
    ),
    "pose beyond all bounds": (
        _settings(lambda s: s["view"][7].update(rt_cam_ref=[0.0, 0.0, 0.0, 1e12, 0.0, 0.0])),
        "BadValue",
        "view[7] has the pose",
    ),
    "node beyond all bounds": (_settings(lambda s: s["view"][7].update(node=[0, 10**12])), "BadValue", "view[7] has"),
    "exposure beyond all bounds": (_settings(lambda s: s.update(exposure_s=1e9)), "BadValue", "exposure_s = 10000000"),
    "gain that overflows": (
        _settings(lambda s: s["noise"].update(gain_dn_per_e=1e-12)),
        "BadValue",
        "gain_dn_per_e must lie within [1e-06, 1e+06]",
    ),
    "name longer than any": (_settings(lambda s: s["view"][7].update(image="x" * 5000)), "MissingFile", "xxx is named"),
    "pipe among the views": (
        _pipe,
        "MissingFile",
        "view_r2_c1.tiff is named",
    ),
    "truth that leads outside": (
        _content(
            "truth.json",
            lambda b: b.replace(b': "noise_free"', b': "../../else"'),
        ),
        "BadValue",
        "leaves the folder",
    ),
    "damaged truth": (_content("truth.json", lambda b: b[:50]), "BadValue", "truth.json"),
    "truncated noise reference": (_content("noise_reference.tiff", lambda b: b[:99]), "UnreadableImage", "noise_ref"),
}

# What `darken` does not read
ONLY_RECONSTRUCTED = {
    "all pixels saturated",
    "blind pixels",
    "lens that folds the image",
    "damaged truth",
    "truth that leads outside",
    "truncated noise reference",
}

CASES = [
    (command, case)
    for command in ("reconstruct", "darken")
    for case in DAMAGED
    if not (command == "darken" and case in ONLY_RECONSTRUCTED)
]


def _files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("command", "case"), CASES)
def test_bad_input_is_named_in_one_line_and_leaves_nothing_half_written(
    command: str, case: str, whole_set: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    damage, failure, words = DAMAGED[case]
    folder = Path(shutil.copytree(whole_set, tmp_path / "set"))
    damage(folder)
    before = _files(tmp_path)
    out = tmp_path / "out"
    arguments = {
        "reconstruct": ["reconstruct", str(folder), "--out", str(out), "--depth-mm", "500", "--passes", "2"],
        "darken": ["darken", str(folder), str(out)],
    }[command]
    assert run(arguments) == 1
    said, complaint = capfd.readouterr()
    assert said == ""
    assert complaint.startswith(f"faintfield: {failure}: ")
    assert words in complaint
    assert len(complaint.splitlines()) == 1
    assert _files(tmp_path) == before


@pytest.mark.parametrize("depth", ["-500", "0", "nan", "inf"])
def test_a_plane_that_is_not_in_front_of_the_camera_is_refused(
    depth: str, whole_set: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(["reconstruct", str(whole_set), "--out", str(tmp_path / "out"), "--depth-mm", depth]) == 1
    said, complaint = capfd.readouterr()
    assert said == ""
    assert complaint.startswith("faintfield: GeometryMismatch: a plane at ")
    assert len(complaint.splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["view_r2_c1.tiff", "view_r2_c1.png"])
def test_decoders_add_no_words_of_their_own(name: str, whole_set: Path, tmp_path: Path) -> None:
    """In a process of its own: what a decoder logs or prints goes to the same place as the error's one line."""
    folder = Path(shutil.copytree(whole_set, tmp_path / "set"))
    whole = (folder / "view_r2_c1.tiff").read_bytes()
    if name.endswith(".png"):
        import cv2

        content = bytearray(cv2.imencode(".png", tifffile.imread(folder / "view_r2_c1.tiff"))[1].tobytes())
        content[len(content) // 2] ^= 0xFF
        _settings(lambda s: s["view"][7].update(image=name))(folder)
    else:
        content = bytearray(whole[:8])  # a header that leads nowhere, which the reader logs
    (folder / name).write_bytes(content)
    words = ["reconstruct", str(folder), "--out", str(tmp_path / "out"), "--depth-mm", "500"]
    code = f"from faintfield.pipelines.cli import main; main({words!r})"
    ended = run_process([sys.executable, "-c", code], capture_output=True, text=True, timeout=HANG_S, check=False)
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr.startswith("faintfield: UnreadableImage: ")
    assert len(ended.stderr.splitlines()) == 1
    assert not (tmp_path / "out").exists()
