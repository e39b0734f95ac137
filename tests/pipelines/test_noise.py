"""`faintfield noise` from files to files, and everything that can be wrong with the files."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from faintfield.calib.noise import Conditions, calibrate, measure_series
from faintfield.pipelines.cli import run
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.files import write_json
from faintfield.pipelines.formats.frames import Frame, exif_exposure_s
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.results.noise import read_fitted_noise
from faintfield.pipelines.formats.sets.elemental_file import Camera, ElementalSetFile, View, write_set
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.pages.noise_page import page_plots
from tests.calib.noise.darkroom import darks, specimen
from tests.pipelines.forms import check_layout
from tests.pipelines.noise_sets import measure_sensor, take_set, write_frames

DATA = os.environ.get("FAINTFIELD_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="FAINTFIELD_DATA does not name the folder of real data")


def written(folder: Path) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((folder / "noise.json").read_text())
    return result


def test_numbers_maps_and_page_are_written(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    chip, rng = specimen(1, hot_fraction=0.005, prnu=0.01)
    folder = write_frames(tmp_path / "set", take_set(chip, rng, photons=(4000.0, 20000.0)), saturation_dn=65535.0)
    assert run(["noise", str(folder), "--json"]) == 0
    out, err = capfd.readouterr()
    result = written(folder)
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
    assert (folder / "noise_page.png").read_bytes().startswith(b"\x89PNG")
    check_layout(folder / "noise.json", "noise.json", "fit", "emva1288")
    with np.load(folder / "noise_maps.npz", allow_pickle=False) as maps:
        shapes = {name: (maps[name].shape, str(maps[name].dtype)) for name in maps}
    floats = {
        "offset_dn",
        "offset_variance_dn2",
        "dark_current_e_per_s",
        "dark_current_variance_e2_per_s2",
        "read_noise_e",
        "read_noise_se_e",
        "relative_response",
        "relative_response_se",
        "vignetting",
    }
    assert shapes == dict.fromkeys(floats, ((64, 64), "float32")) | {"mask": ((64, 64), "bool")}


def test_the_page_leaves_out_what_it_could_not_show() -> None:
    chip, rng = specimen(17, dsnu_e=0.0)
    series = [measure_series(frames, Conditions("dark", t)) for t, frames in darks(chip, [0.1], 4, rng).items()]
    short = calibrate(series)
    shown = [plot.title for plot in page_plots(short) if plot.missing is None]
    assert shown[:3] == ["Photon transfer", "Dark signal against exposure time", "Results, 95 % intervals"]
    missing = {plot.title: plot.missing for plot in page_plots(short) if plot.missing}
    assert (
        missing["Dark current [e⁻/s]"] == missing["Relative response to light"] == "not identifiable from these frames"
    )
    assert "no gain" in missing["Dark values and the fitted mass function"]
    series = [
        measure_series(frames, Conditions("dark", t)) for t, frames in darks(chip, (0.1, 10.0, 60.0), 4, rng).items()
    ]
    longer = calibrate(series)
    assert len([plot for plot in page_plots(longer) if plot.missing is None]) > 6


def test_the_result_is_what_reconstruction_reads(tmp_path: Path) -> None:
    chip, rng = specimen(2, hot_fraction=0.005)
    result = measure_sensor(write_frames(tmp_path / "set", take_set(chip, rng, frames=10)), folder := tmp_path / "out")
    files = {"noise.json", "noise_maps.npz", "noise_page.png", "emva1288_report.html"}
    assert {path.name for path in folder.iterdir()} == files
    assert not (tmp_path / "set" / "noise.json").exists()
    fitted = read_fitted_noise(folder / "noise.json", (64, 64))
    assert np.shape(fitted.model.offset_dn) == (64, 64)
    assert fitted.model.gain_dn_per_e == result.gain_dn_per_e.value
    assert fitted.model.saturation_dn == 65535
    np.testing.assert_array_equal(np.argwhere(fitted.unusable), result.hot_pixels)


def test_a_noise_json_written_by_hand_needs_four_numbers_only(tmp_path: Path) -> None:
    numbers = {"offset_dn": 10.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.5, "dark_current_e_per_s": 0.2}
    path = tmp_path / "noise.json"
    path.write_text(json.dumps({name: {"value": value} for name, value in numbers.items()}))
    fitted = read_fitted_noise(path, (4, 3))
    assert {name: getattr(fitted.model, name) for name in numbers} == numbers
    assert fitted.unusable.shape == (3, 4)
    assert not fitted.unusable.any()
    assert (fitted.response, fitted.mosaic, fitted.model.quantum_efficiency) == (None, None, None)
    path.write_text(json.dumps({"offset_dn": {"value": 10.0}}))
    with pytest.raises(BadValue, match="gain_dn_per_e"):
        read_fitted_noise(path, (4, 3))


def test_what_cannot_be_told_is_null_with_the_reason(tmp_path: Path) -> None:
    chip, rng = specimen(3)
    folder = write_frames(tmp_path, take_set(chip, rng, (0.1, 0.5, 1.0)))
    measure_sensor(folder)
    result = written(folder)
    for name in ("gain_dn_per_e", "read_noise_e", "dark_current_e_per_s", "quantum_efficiency", "prnu"):
        assert result[name]["value"] is None
        assert "record" in result[name]["why"] or "photons" in result[name]["why"]
    assert result["covariance"]["names"] == ["offset_dn"]
    with pytest.raises(BadValue, match="gain_dn_per_e is not known"):
        read_fitted_noise(folder / "noise.json", (64, 64))


def test_colour_phases_are_planes_of_their_own(tmp_path: Path) -> None:
    chip, rng = specimen(4, shape=(96, 96))
    chip.offset_dn[1::2, 0::2] += 50
    folder = write_frames(tmp_path, take_set(chip, rng, photons=(10000.0,)), mosaic=["RG", "GB"])
    result = measure_sensor(folder)
    check_layout(folder / "noise.json", "noise_of_a_mosaic.json")
    assert isinstance(result.planes, list)
    assert [plane.colour for plane in result.planes] == ["R", "G", "G", "B"]
    offsets = [plane.offset_dn.value for plane in result.planes]
    assert offsets == pytest.approx([100, 100, 150, 100], abs=0.6)
    with np.load(folder / "noise_maps.npz") as maps:
        assert np.sqrt(np.mean((maps["offset_dn"] - chip.offset_dn) ** 2)) < 2.5
        assert maps["gain_dn_per_e"].shape == (96, 96)
    assert sorted(path.name for path in folder.glob("*.png"))[0] == "noise_page_B_r1c1.png"


def test_pixels_outside_the_region_are_masked(tmp_path: Path) -> None:
    chip, rng = specimen(5)
    frames = take_set(chip, rng)
    for pixels, _ in frames:
        pixels[:, :10] = 7
    folder = write_frames(tmp_path, frames, region={"rows": [0, 64], "columns": [10, 64]})
    measure_sensor(folder)
    with np.load(folder / "noise_maps.npz") as maps:
        assert maps["mask"][:, :10].all()
        assert not maps["mask"][:, 10:].any()


def fails(folder: Path, capfd: pytest.CaptureFixture[str]) -> str:
    """Run the command, which must fail by name and write nothing; return its last line, after those of progress."""
    assert run(["noise", str(folder)]) == 1
    assert not (folder / "noise.json").exists()
    assert not (folder / "noise_maps.npz").exists()
    *progress, failure = capfd.readouterr().err.strip().splitlines()
    assert all(line.startswith("reading frames: ") for line in progress)  # on a slow machine
    return failure


def test_a_truncated_tiff_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = write_frames(tmp_path, take_set(*specimen(7)))
    path = folder / "dark_05.tiff"
    path.write_bytes(path.read_bytes()[:2000])
    assert "dark_05.tiff: cannot be decoded" in fails(folder, capfd)


def test_a_frame_of_another_size_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = write_frames(tmp_path, take_set(*specimen(8)))
    tifffile.imwrite(folder / "dark_06.tiff", np.zeros((64, 60), np.uint16))
    assert "WrongSize" in (line := fails(folder, capfd))
    assert "dark_06.tiff: is 60 x 64 px, the other frames 64 x 64 px" in line


def test_a_light_leak_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = write_frames(tmp_path, take_set(*specimen(9)))
    pixels = tifffile.imread(folder / "dark_09.tiff")
    tifffile.imwrite(folder / "dark_09.tiff", pixels + np.uint16(60))
    assert "LightLeak" in (line := fails(folder, capfd))
    assert "dark_09.tiff" in line


def test_a_saturated_flat_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    frames = take_set(*specimen(10), photons=(4200.0,))
    folder = write_frames(tmp_path, [(np.minimum(pixels, 4095), keys) for pixels, keys in frames], saturation_dn=4095.0)
    assert "SaturatedFlat" in (line := fails(folder, capfd))
    assert "flat_16.tiff" in line


def test_copies_are_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = write_frames(tmp_path, take_set(*specimen(11)))
    (folder / "dark_01.tiff").write_bytes((folder / "dark_00.tiff").read_bytes())
    assert "CopiedFrame" in (line := fails(folder, capfd))
    assert "dark_01.tiff" in line
    assert "dark_00.tiff" in line


def test_one_frame_of_each_exposure_is_too_few(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = write_frames(tmp_path, take_set(*specimen(12), frames=1))
    assert "TooFewFrames" in (line := fails(folder, capfd))
    assert "dark_00.tiff" in line


def test_a_missing_exposure_is_an_error_and_a_missing_temperature_a_warning(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    frames = take_set(*specimen(13))
    for _, keys in frames:
        del keys["temperature_c"]
    del frames[2][1]["exposure_s"]
    line = fails(write_frames(tmp_path / "a", frames), capfd)
    assert "dark_02.tiff: its exposure is neither stated nor in its EXIF" in line
    frames[2][1]["exposure_s"] = 0.1
    result = measure_sensor(write_frames(tmp_path / "b", frames))
    assert result.temperature_c is None
    assert any("dark_00.tiff: no temperature" in warning for warning in result.warnings)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"colour": 3}, "UnknownKey: .*'colour' is not a key"),
        ({"region": {"rows": [0, 65], "columns": [0, 64]}}, r"region.rows = \[0, 65\]"),
        ({"frame": [{"file": "../x.tiff", "kind": "dark", "exposure_s": 1.0}]}, "leaves the folder"),
        ({"frame": [{"file": "dark_00.tiff", "kind": "dark", "exposure_s": 1.0}] * 2}, "named twice"),
    ],
)
def test_bad_settings_are_named(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], change: dict[str, Any], words: str
) -> None:
    import re
    import tomllib

    import tomli_w

    folder = write_frames(tmp_path, take_set(*specimen(14), frames=2))
    settings = tomllib.loads((folder / "noise.toml").read_text()) | change
    (folder / "noise.toml").write_text(tomli_w.dumps(settings))
    assert re.search(words, fails(folder, capfd))


@needs_data
def test_a_real_ccd_comes_out_as_published(tmp_path: Path) -> None:
    """Photon transfer published with the frames: 2.529 e⁻/DN, 4.03 DN of read noise (rounding included)."""
    source = Path(str(DATA)) / "ccd-frames"
    names = ("led_dark_a", "led_dark_b", "dark_12s", "led_a", "led_b")
    keys = [("dark", 2.0), ("dark", 2.0), ("dark", 12.0), ("flat", 2.0), ("flat", 2.0)]
    frames = [
        (tifffile.imread(source / f"{name}.tiff"), {"kind": kind, "exposure_s": t})
        for name, (kind, t) in zip(names, keys, strict=True)
    ]
    region = {"rows": [8, 520], "columns": [50, 1074]}
    result = measure_sensor(write_frames(tmp_path, frames, region=region))
    assert result.gain_dn_per_e.value is not None
    assert 1 / result.gain_dn_per_e.value == pytest.approx(2.529, rel=0.002)
    assert result.read_noise_dn.value == pytest.approx(4.03, rel=0.005)
    assert result.dark_current_e_per_s.why is not None
    assert "black level drifted" in result.dark_current_e_per_s.why


@pytest.mark.deep
@needs_data
def test_a_real_ccd_whose_black_level_fell_is_not_told_more_than_it_shows(tmp_path: Path) -> None:
    source = Path(str(DATA)) / "ccd-frames"
    exposures_s = {"led_dark_a": 1.0, "led_dark_b": 1.0, "dark_2s": 2.0, "dark_12s": 12.0, "led_a": 1.0, "led_b": 1.0}
    frames = [
        (tifffile.imread(source / f"{name}.tiff"), {"kind": "dark" if "dark" in name else "flat", "exposure_s": t})
        for name, t in exposures_s.items()
    ]
    result = measure_sensor(write_frames(tmp_path, frames, region={"rows": [8, 520], "columns": [50, 1074]}))
    whys = {
        "dark_current_e_per_s": "does not rise with exposure time",
        "dcnu_e_per_s": "only one exposure has more than one dark",
        "dsnu_e": "less scatter than the pixels' noise",
    }
    for name, why in whys.items():
        measured = getattr(result, name)
        assert measured.value is None, name
        assert why in measured.why, name


@needs_data
def test_a_raw_file_brings_its_mosaic_but_not_always_its_exposure(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """This one's EXIF states no exposure; the decoder would make it 1 s."""
    raw = Path(str(DATA)) / "raw" / "colorchart.dng"
    assert exif_exposure_s(raw) is None
    (tmp_path / "one.dng").write_bytes(raw.read_bytes())
    entry = 'format = 1\n[[frame]]\nfile = "one.dng"\nkind = "dark"\n'
    (tmp_path / "noise.toml").write_text(entry)
    assert "one.dng: its exposure is neither stated nor in its EXIF" in fails(tmp_path, capfd)
    (tmp_path / "noise.toml").write_text(entry + "exposure_s = 0.5\n")
    assert "TooFewFrames: plane R_r0c0" in (line := fails(tmp_path, capfd))
    assert "one.dng: the only one of the darks of 0.5 s" in line


def raw_like(path: Path, *_: object, **__: object) -> Frame:
    """Return a TIFF as if it were a raw file with masked pixels and EXIF."""
    level = np.array([[100.0, 100.0], [100.0, 140.0]])
    return Frame(tifffile.imread(path), ("RG", "GB"), level, 4095.0, 1.0)


def test_masked_pixels_that_disagree_with_the_darks_raise_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("faintfield.pipelines.calibration.noise_frames.read_frame", raw_like)
    result = measure_sensor(write_frames(tmp_path, take_set(*specimen(16, shape=(96, 96)))))
    assert isinstance(result.planes, list)
    assert [plane.masked_black_dn for plane in result.planes] == [100, 100, 100, 140]
    assert result.saturation_dn == 4095
    warnings = [warning for warning in result.warnings if "black level stated in the files" in warning]
    assert len(warnings) == 1
    assert warnings[0].startswith("plane B_r1c1: the darks' offset is ")


def test_the_response_that_flats_measured_is_the_flat_field_of_a_set(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    response = np.linspace(0.5, 1.5, 12, dtype=np.float32).reshape(3, 4)
    hot = np.zeros((3, 4), bool)
    hot[1, 2] = True
    np.savez(folder / "noise_maps.npz", relative_response=response, mask=hot)
    numbers = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0, "dark_current_e_per_s": -0.01}
    write_json(folder / "noise.json", {name: {"value": value} for name, value in numbers.items()})
    write_frame(folder / "view.tiff", np.full((3, 4), 110, np.uint16))
    camera = Camera((4, 3), 4.0, 4.0, 1.5, 1.0)
    write_set(
        folder,
        ElementalSetFile(
            format=1,
            exposure_s=0.1,
            reference_view=0,
            camera=camera,
            noise="noise.json",
            view=[View("view.tiff", (0, 0, 0, 0, 0, 0))],
        ),
    )
    loaded = load_set(folder)
    assert loaded.flat is not None
    np.testing.assert_array_equal(loaded.flat[~hot], response[~hot])
    np.testing.assert_array_equal(loaded.unusable, hot)
    assert loaded.noise.dark_current_e_per_s == 0
