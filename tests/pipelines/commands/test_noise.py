"""`faintfield noise` from files to files, and everything that can be wrong with the files."""

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import tomli_w
from numpy.typing import NDArray

from faintfield.pipelines.cli import run
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.frames import Frame
from faintfield.pipelines.formats.results.noise import read_fitted_noise
from tests.calib.noise.darkroom import specimen
from tests.pipelines.forms import check_layout, read_record
from tests.pipelines.noise_sets import measure_sensor, take_set, write_frames


def test_numbers_maps_and_page_are_written(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    chip, rng = specimen(1, hot_fraction=0.005, prnu=0.01)
    folder = write_frames(tmp_path / "set", take_set(chip, rng, photons=(4000.0, 20000.0)), saturation_dn=65535.0)
    assert run(["noise", str(folder), "--json"]) == 0
    out, err = capfd.readouterr()
    result = read_record(folder, "noise.json")
    assert json.loads(out) | {"record_sha256": result["record_sha256"]} == result
    assert "K, system gain" in err
    assert result["gain_dn_per_e"]["value"] == pytest.approx(2, rel=0.03)
    low, high = result["read_noise_e"]["ci95"]
    assert low < result["read_noise_e"]["value"] < high
    assert result["likelihood"] == "marginal Gaussian"
    assert result["standard"].startswith("EMVA 1288 release 4")
    assert result["temperature_c"] == {"mean": -10, "min": -10, "max": -10}
    assert np.array(result["covariance"]["matrix"]).shape == (4, 4)
    assert set(result["provenance"]["inputs"]) == {"noise.toml", *(frame["file"] for frame in result["frames"])}
    assert "<svg" in (folder / "noise.html").read_text()
    check_layout(folder / "noise.json", "noise.json", "fit", "emva1288")
    with np.load(folder / "noise_maps.npz", allow_pickle=False) as maps:
        shapes = {name: (maps[name].shape, str(maps[name].dtype)) for name in maps}
    floats = {
        *("offset_dn", "offset_variance_dn2", "dark_current_e_per_s", "dark_current_variance_e2_per_s2"),
        *("read_noise_e", "read_noise_se_e", "relative_response", "relative_response_se", "vignetting"),
    }
    assert shapes == dict.fromkeys(floats, ((64, 64), "float32")) | {"mask": ((64, 64), "bool")}


def test_unknown_numbers_are_null_with_reason(tmp_path: Path) -> None:
    """Only the columns from 10 on are in use; no frame has a temperature."""
    frames = take_set(*specimen(3), (0.1, 0.5, 1.0))
    for pixels, keys in frames:
        pixels[:, :10] = 7
        del keys["temperature_c"]
    folder = write_frames(tmp_path, frames, region={"rows": [0, 64], "columns": [10, 64]})
    assert any("dark_00.tiff: no temperature" in warning for warning in measure_sensor(folder).warnings)
    result = read_record(folder, "noise.json")
    assert result["temperature_c"] is None
    for name in ("gain_dn_per_e", "read_noise_e", "dark_current_e_per_s", "quantum_efficiency", "prnu"):
        assert result[name]["value"] is None
        assert "record" in result[name]["why"] or "photons" in result[name]["why"]
    assert result["covariance"]["names"] == ["offset_dn"]
    with np.load(folder / "noise_maps.npz") as maps:
        assert maps["mask"][:, :10].all()
        assert not maps["mask"][:, 10:].any()
    with pytest.raises(BadValue, match="gain_dn_per_e is not known"):
        read_fitted_noise(folder / "noise.json", (64, 64))


def test_colour_phases_are_separate_planes(tmp_path: Path) -> None:
    chip, rng = specimen(4)
    chip.offset_dn[1::2, 0::2] += 50
    folder = write_frames(tmp_path, take_set(chip, rng, photons=(10000.0,)), mosaic=["RG", "GB"])
    earlier = ("noise_page.png", "noise_page_B_r1c1.png", "emva1288_report.html")
    for name in (*earlier, "noise_page_of_mine.png"):
        (folder / name).touch()
    result = measure_sensor(folder)
    assert not [name for name in earlier if (folder / name).exists()]
    assert (folder / "noise_page_of_mine.png").exists()
    check_layout(folder / "noise.json", "noise_of_a_mosaic.json")
    assert isinstance(result.planes, list)
    assert [plane.colour for plane in result.planes] == ["R", "G", "G", "B"]
    offsets = [plane.offset_dn.value for plane in result.planes]
    assert offsets == pytest.approx([100, 100, 150, 100], abs=0.6)
    with np.load(folder / "noise_maps.npz") as maps:
        assert np.sqrt(np.mean((maps["offset_dn"] - chip.offset_dn) ** 2)) < 2.5
        assert maps["gain_dn_per_e"].shape == (64, 64)


def failure_of(folder: Path, capfd: pytest.CaptureFixture[str]) -> str:
    """Run the command, which must fail by name and write nothing; return its last line, after those of progress."""
    assert run(["noise", str(folder)]) == 1
    assert not (folder / "noise.json").exists()
    assert not (folder / "noise_maps.npz").exists()
    *progress, failure = capfd.readouterr().err.strip().splitlines()
    assert all(line.startswith("reading frames: ") for line in progress)  # on a slow machine
    return failure


DAMAGES: list[tuple[int, Callable[[NDArray[np.uint16], dict[str, Any]], Any], str]] = [
    (6, lambda pixels, keys: pixels[:, :60], "WrongSize: .*dark_06.tiff: is 60 x 64 px, the other frames 64 x 64 px"),
    (9, lambda pixels, keys: pixels + np.uint16(60), "LightLeak: .*dark_09.tiff"),
    (16, lambda pixels, keys: np.minimum(pixels, 4095), "SaturatedFlat: .*flat_16.tiff"),
    (2, lambda pixels, keys: keys.pop("exposure_s") and pixels, "dark_02.tiff: its exposure is neither stated nor in"),
]


@pytest.mark.parametrize(("index", "damage", "words"), DAMAGES)
def test_unfit_frames_are_named(
    index: int, damage: Callable[..., Any], words: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    frames = take_set(*specimen(10), photons=(4200.0,))
    frames[index] = (damage(*frames[index]), frames[index][1])
    assert re.search(words, failure_of(write_frames(tmp_path, frames, saturation_dn=4095.0), capfd))


@pytest.mark.parametrize("cut", [True, False])
def test_copied_or_truncated_frames_are_named(cut: bool, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = write_frames(tmp_path, take_set(*specimen(7)))
    content = (folder / "dark_00.tiff").read_bytes()
    (folder / "dark_01.tiff").write_bytes(content[:2000] if cut else content)
    words = "dark_01.tiff: cannot be decoded" if cut else "CopiedFrame: .*dark_0[01].tiff.*dark_0[01].tiff"
    assert re.search(words, failure_of(folder, capfd))


def test_bad_settings_are_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = write_frames(tmp_path, take_set(*specimen(14), frames=2))
    settings = tomllib.loads((folder / "noise.toml").read_text())
    frame = {"file": "dark_00.tiff", "kind": "dark", "exposure_s": 1.0}
    changes: list[tuple[dict[str, Any], str]] = [
        ({"colour": 3}, "UnknownKey: .*'colour' is not a key"),
        ({"region": {"rows": [0, 65], "columns": [0, 64]}}, r"region.rows = \[0, 65\]"),
        ({"frame": [frame | {"file": "../x.tiff"}]}, "leaves the folder"),
        ({"frame": [frame] * 2}, "named twice"),
        ({"saturation_dn": 70000}, "saturation_dn = 70000; the uint16 values of .* end at 65535"),
    ]
    for change, words in changes:
        (folder / "noise.toml").write_text(tomli_w.dumps(settings | change))
        assert re.search(words, failure_of(folder, capfd))


def test_real_ccd_is_as_published(real_data: Path, tmp_path: Path) -> None:
    """Photon transfer published with the frames: 2.529 e⁻/DN, 4.03 DN of read noise (rounding included)."""
    frames = []
    for name in ("led_dark_a", "led_dark_b", "dark_12s", "led_a", "led_b"):
        keys = {"kind": "dark" if "dark" in name else "flat", "exposure_s": 12.0 if name == "dark_12s" else 2.0}
        frames.append((tifffile.imread(real_data / "ccd-frames" / f"{name}.tiff"), keys))
    result = measure_sensor(write_frames(tmp_path, frames, region={"rows": [8, 520], "columns": [50, 1074]}))
    assert result.gain_dn_per_e.value is not None
    assert 1 / result.gain_dn_per_e.value == pytest.approx(2.529, rel=0.002)
    assert result.read_noise_dn.value == pytest.approx(4.03, rel=0.005)
    assert result.dark_current_e_per_s.why is not None
    assert "black level drifted" in result.dark_current_e_per_s.why


def test_masked_pixels_unlike_darks_raise_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def raw_frame(path: Path, *_: object, **__: object) -> Frame:
        level = np.array([[100.0, 100.0], [100.0, 140.0]])
        return Frame(tifffile.imread(path), ("RG", "GB"), level, 4095.0, 1.0)

    monkeypatch.setattr("faintfield.pipelines.calibration.noise.read_frame", raw_frame)
    folder, out = write_frames(tmp_path / "set", take_set(*specimen(16), frames=2)), tmp_path / "out"
    result = measure_sensor(folder, out)
    assert {path.name for path in out.iterdir()} >= {"noise.json", "noise_maps.npz", "noise.html"}
    assert not (folder / "noise.json").exists()
    assert isinstance(result.planes, list)
    assert [plane.masked_black_dn for plane in result.planes] == [100, 100, 100, 140]
    assert result.saturation_dn == 4095
    (warning,) = [warning for warning in result.warnings if "black level stated in the files" in warning]
    assert warning.startswith("plane B_r1c1: the darks' offset is ")


def test_warnings_of_all_colours_are_given_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def raw_frame(path: Path, *_: object, **__: object) -> Frame:
        return Frame(tifffile.imread(path), ("RG", "GB"), np.array([[140.0, 141.0], [142.0, 143.0]]), 4095.0, 1.0)

    monkeypatch.setattr("faintfield.pipelines.calibration.noise.read_frame", raw_frame)
    result = measure_sensor(write_frames(tmp_path / "set", take_set(*specimen(16), frames=2)), tmp_path / "out")
    texts = [warning.rpartition(": ")[2] for warning in result.warnings]
    assert len(set(texts)) == len(texts)
    (warning,) = [warning for warning in result.warnings if "black level stated in the files" in warning]
    assert warning.startswith("all planes, with the numbers of R_r0c0: the darks' offset is ")
    assert "stated in the files 140.0 DN" in warning
