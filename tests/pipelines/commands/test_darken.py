"""`darken`: a bright set exposed anew with a few photons per pixel."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from tests.pipelines.by_hand import channels_of
from tests.pipelines.conftest import SMALL, Command, Edit, SetMaker, assert_refused
from tests.pipelines.noise_sets import check_noise_of_eq_6, deviation_of_snr

READ_VARIANCE_E2 = 12 + 1 / 48
DARK_E = 0.02


def _scene_light(shape: tuple[int, int], generator: np.random.Generator) -> NDArray[np.float64]:
    """A bright disc with detail on it, in front of a dim background; between 0 and 1."""
    rows, columns = np.indices(shape)
    disc = np.hypot(rows - shape[0] / 2, columns - shape[1] / 2) < 0.35 * min(shape)
    detail = cv2.GaussianBlur(generator.uniform(0, 1, shape), None, 2.0)
    return np.asarray(np.where(disc, 0.6 + 1.5 * (detail - 0.5), 0.1))


def _light(folder: Path) -> NDArray[np.float64]:
    """Return the light of a set's reference view, in electrons of the bright camera: (colour, row, column)."""
    return np.array([np.maximum(images.electrons[0].astype(float), 0) for images in channels_of(folder).values()])


def _darken(done: Command, bright: Path, out: Path, *options: object) -> dict[str, float]:
    result: dict[str, float] = json.loads(done("--json", "darken", bright, out, *options).stdout)
    return result


@pytest.fixture
def bright(make_set: SetMaker) -> Path:
    """Three grey views, 200 x 150 px."""
    generator = np.random.default_rng(20110919)
    views = [np.rint(100 + 20_000 * _scene_light((150, 200), generator)).astype(np.uint16) for _ in range(3)]
    return make_set(views, name="bright")


@pytest.mark.parametrize("snr", [0.16, 2.0])
def test_measured_snr_is_that_asked_for(snr: float, bright: Path, tmp_path: Path, done: Command) -> None:
    result = _darken(done, bright, tmp_path / "dark", "--snr", snr)
    region = read_frame(tmp_path / "dark" / "object_region.png").pixels_dn > 127
    mean_e = result["scale_e"] * _light(bright)[0][region]
    deviation = deviation_of_snr(snr, mean_e, READ_VARIANCE_E2, region)
    assert result["snr"] == snr
    assert result["snr_measured"] == pytest.approx(snr, abs=4 * deviation)
    assert deviation < 0.15 * snr
    expected = (np.mean((mean_e + DARK_E) ** 2 + mean_e + DARK_E) - DARK_E**2 - DARK_E) / (12 + DARK_E + DARK_E**2)
    assert expected == pytest.approx(snr, rel=1e-3)
    assert result["photons_on_object"] == pytest.approx(mean_e.mean() / 0.5, rel=1e-4)
    assert np.mean(region == (_light(bright)[0] > 0.25 * 10_000)) > 0.999


def test_views_are_bright_ones_scaled_with_noise(
    bright: Path, tmp_path: Path, done: Command, faintfield: Command
) -> None:
    """The noise is that of eq. (6), the same again by the same seed only; a camera without it is refused."""
    scale_e = _darken(done, bright, tmp_path / "dark")["scale_e"]
    for name, seed in (("again", 1), ("other", 2)):
        done("darken", bright, tmp_path / name, "--seed", seed)
    names = [*(f"view_{column}.tiff" for column in range(3)), "noise_reference.tiff"]
    made = {run: [(tmp_path / run / name).read_bytes() for name in names] for run in ("dark", "again", "other")}
    assert made["dark"] == made["again"]
    assert not set(made["dark"]) & set(made["other"])
    ended = faintfield("darken", bright, tmp_path / "none", "--read-noise-e", 0, "--dark-current-e-per-s", 0)
    assert_refused(ended, "BadValue", "must both be positive")
    assert not (tmp_path / "none").exists()
    bright_views, dark_views = (channels_of(folder)["grey"].electrons for folder in (bright, tmp_path / "dark"))
    expected = scale_e * np.maximum(bright_views.astype(float), 0) + DARK_E
    residuals = [check_noise_of_eq_6(*view, READ_VARIANCE_E2) for view in zip(dark_views, expected, strict=True)]
    # Noise is drawn anew for each view
    first, second = (view.ravel() for view in residuals[:2])
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(first.size)


def test_views_keep_poses_lens_and_flat(bright: Path, tmp_path: Path, done: Command, edit: Edit) -> None:
    flat = np.linspace(0.5, 1, 150 * 200, dtype=np.float32).reshape(150, 200)
    tifffile.imwrite(bright / "response.tif", flat)
    edit(bright, lambda settings: settings["camera"].update(flat="response.tif"))
    done("darken", bright, tmp_path / "flat")
    np.testing.assert_array_equal(load_set(tmp_path / "flat").flat, flat)
    edit(bright, lambda settings: settings["camera"].pop("flat"))
    edit(bright, lambda settings: settings["view"][2].update(rt_cam_ref=[0.1, 0, 0, -20.3, 0.1, 0.2], cx_px=90.0))
    done("darken", bright, tmp_path / "dark", "--exposure-s", 0.25)
    before, after = load_set(bright).settings, load_set(tmp_path / "dark").settings
    assert after.view == before.view
    assert after.camera == before.camera
    assert after.reference_view == before.reference_view
    assert after.exposure_s == 0.25


def test_dark_camera_is_that_described(bright: Path, tmp_path: Path, done: Command) -> None:
    options = ("--read-noise-e", 5, "--dark-current-e-per-s", 1.5, "--quantum-efficiency", 0.9)
    done("darken", bright, tmp_path / "dark", *options)
    noise = load_set(tmp_path / "dark").noise
    assert (noise.read_noise_e, noise.dark_current_e_per_s, noise.quantum_efficiency) == (5.0, 1.5, 0.9)
    nothing = noise.electrons(read_frame(tmp_path / "dark" / "noise_reference.tiff").pixels_dn)
    assert nothing.mean() == pytest.approx(0.15, abs=4 * 5 / np.sqrt(nothing.size))
    assert nothing.std() == pytest.approx(np.sqrt(25 + 0.15 + 1 / 48), rel=4 / np.sqrt(2 * nothing.size))


@pytest.mark.parametrize("mean_e", [1, 8])
def test_set_that_is_dark_already_is_refused(
    mean_e: int, make_set: SetMaker, tmp_path: Path, faintfield: Command
) -> None:
    """Of 8 electrons with a read noise of 3.5, noise is (8 + 12) / (64 + 20) of the power; of 1 electron, most."""
    generator = np.random.default_rng(20110919)
    exposed_e = generator.poisson(mean_e, (150, 200)) + generator.normal(0, 12**0.5, (150, 200))
    noise = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 12**0.5}
    dark = make_set([np.rint(100 + 2 * exposed_e).astype(np.uint16)], noise=noise)
    assert_refused(faintfield("darken", dark, tmp_path / "out"), "BadValue", "is dark already", "at most 10%")
    assert not (tmp_path / "out").exists()


def test_noise_of_bright_set_that_stays_is_told(make_set: SetMaker, tmp_path: Path, done: Command) -> None:
    """The brighter half of 200 electrons has 211; SNR 1000 scales by 0.52: 0.27 (211 + 12) is 49 % of 109 + 12."""
    exposed_e = np.random.default_rng(20110919).poisson(200, (150, 200))
    noise = {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 12**0.5}
    bright = make_set([np.rint(100 + 2 * exposed_e).astype(np.uint16)], noise=noise)
    assert "adds 49%" in done("darken", bright, tmp_path / "little", "--snr", 1000).stderr
    assert "warning" not in done("darken", bright, tmp_path / "dark", "--snr", 0.16).stderr


def test_dim_light_without_noise_is_darkened(tmp_path: Path, done: Command) -> None:
    done("simulate", tmp_path / "scene", *SMALL)
    done("darken", tmp_path / "scene" / "noise_free", tmp_path / "dark")
    light, dark = (load_set(folder) for folder in (tmp_path / "scene" / "noise_free", tmp_path / "dark"))
    assert len(dark.image_paths) == len(light.image_paths)


def test_colour_stays_colour(make_set: SetMaker, tmp_path: Path, done: Command) -> None:
    light = _scene_light((150, 200), np.random.default_rng(1))
    colours = np.array([1.0, 0.5, 0.2])
    views = [np.rint(100 + 20_000 * light[:, :, np.newaxis] * colours).astype(np.uint16)] * 2
    folder = make_set(views, name="bright")
    scale_e = _darken(done, folder, tmp_path / "dark", "--snr", 2)["scale_e"]
    assert read_frame(load_set(tmp_path / "dark").image_paths[0]).pixels_dn.shape == (150, 200, 3)
    for index, images in enumerate(channels_of(tmp_path / "dark").values()):
        electrons = images.electrons
        expected = scale_e * _light(folder)[index].mean() + DARK_E
        deviation = np.sqrt((expected + READ_VARIANCE_E2) / electrons.size)
        assert electrons.mean(dtype=float) == pytest.approx(expected, abs=4 * deviation)
        assert deviation < 0.1 * expected


@pytest.mark.parametrize(("light", "tone_curve"), [("relative", True), ("dn", False)])
def test_tone_curve_of_photographs_is_kept(
    light: str, tone_curve: bool, bright: Path, tmp_path: Path, done: Command
) -> None:
    settings = bright / "elemental.toml"
    settings.write_text(settings.read_text() + f'\n[units]\nlight = "{light}"\n')
    done("darken", bright, tmp_path / "dark")
    units = load_set(tmp_path / "dark").units
    assert (units.light, units.tone_curve) == ("electrons", tone_curve)


def test_mosaic_and_dark_pixels_stay(make_set: SetMaker, tmp_path: Path, done: Command) -> None:
    """Pixels without light, of one colour or in one half, count as dark, also when they are below the offset of 100."""
    frame = np.rint(100 + 20_000 * _scene_light((150, 200), np.random.default_rng(1))).astype(np.uint16)
    frame[1::2, 1::2] = 90  # no blue at all
    done("darken", make_set([frame], camera={"mosaic": ["RG", "GB"]}), tmp_path / "dark", "--snr", 5)
    assert load_set(tmp_path / "dark").settings.camera.mosaic == ("RG", "GB")
    means = {name: images.electrons.mean() for name, images in channels_of(tmp_path / "dark").items()}
    assert means["blue"] == pytest.approx(DARK_E, abs=4 * np.sqrt(READ_VARIANCE_E2 / (75 * 100)))
    assert min(means["red"], means["green"]) > 1.0


@pytest.mark.parametrize("names", [("left/frame.tiff", "right/frame.tiff"), ("noise_reference.tif", "flat.tif")])
def test_views_with_colliding_names_stay_apart(
    names: tuple[str, str], bright: Path, tmp_path: Path, done: Command, edit: Edit
) -> None:
    level_dn = (20_100, 10_100)
    for name, level in zip(names, level_dn, strict=True):
        (bright / name).parent.mkdir(exist_ok=True)
        write_frame(bright / name, np.full((150, 200), level, np.uint16))
    edit(bright, lambda settings: [settings["view"][i].update(image=name) for i, name in enumerate(names)])
    scale_e = _darken(done, bright, tmp_path / "dark")["scale_e"]
    electrons = channels_of(tmp_path / "dark")["grey"].electrons
    for view, level in enumerate(level_dn):
        expected = scale_e * (level - 100) / 2 + DARK_E
        deviation = np.sqrt((expected + READ_VARIANCE_E2) / electrons[view].size)
        assert electrons[view].mean(dtype=float) == pytest.approx(expected, abs=4 * deviation)
