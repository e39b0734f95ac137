"""`darken`: a bright set exposed anew with a few photons per pixel."""

import json
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel

type Command = Callable[..., CompletedProcess[str]]
type SetMaker = Callable[..., Path]
type Edit = Callable[[Path, Callable[[dict[str, Any]], object]], Path]

READ_VARIANCE_E2 = 12 + 1 / 48
DARK_E = 0.02


def _scene_light(shape: tuple[int, int], generator: np.random.Generator) -> NDArray[np.float64]:
    """A bright disc with detail on it, in front of a dim background; between 0 and 1."""
    rows, columns = np.indices(shape)
    disc = np.hypot(rows - shape[0] / 2, columns - shape[1] / 2) < 0.35 * min(shape)
    detail = cv2.GaussianBlur(generator.uniform(0, 1, shape), None, 2.0)
    return np.asarray(np.where(disc, 0.6 + 1.5 * (detail - 0.5), 0.1))


def _light(folder: Path) -> NDArray[np.float64]:
    """What a set's reference view says of the light, in electrons of the bright camera: (row, column, colour)."""
    loaded = load_set(folder)
    parts = [load_channel(loaded, layout).electrons[0] for layout in channel_layouts(loaded)]
    return np.asarray(np.maximum(np.dstack(parts).astype(float), 0))


@pytest.fixture
def bright(make_set: SetMaker) -> Path:
    """Three grey views, 200 x 150 px."""
    generator = np.random.default_rng(20110919)
    views = [np.rint(100 + 20_000 * _scene_light((150, 200), generator)).astype(np.uint16) for _ in range(3)]
    return make_set(views, name="bright")


@pytest.mark.parametrize(("snr", "seed"), [(0.16, 1), (2.0, 1)])
def test_the_snr_of_eq_4_measured_is_the_one_asked_for(
    snr: float, seed: int, bright: Path, tmp_path: Path, done: Command
) -> None:
    result = json.loads(done("--json", "darken", bright, tmp_path / "dark", "--snr", snr, "--seed", seed).stdout)
    region = read_frame(tmp_path / "dark" / "object_region.png").pixels_dn > 127
    mean_e = result["scale_e"] * _light(bright)[:, :, 0][region]
    variance = mean_e + READ_VARIANCE_E2
    of_object = np.mean(2 * variance**2 + 4 * mean_e**2 * variance + mean_e + 4 * mean_e**2) / region.sum()
    of_reference = 2 * READ_VARIANCE_E2**2 / region.size
    deviation = np.sqrt(of_object + (1 + snr) ** 2 * of_reference) / READ_VARIANCE_E2
    assert result["snr"] == snr
    assert result["snr_measured"] == pytest.approx(snr, abs=4 * deviation)
    assert deviation < 0.15 * snr
    expected = (np.mean((mean_e + DARK_E) ** 2 + mean_e + DARK_E) - DARK_E**2 - DARK_E) / (12 + DARK_E + DARK_E**2)
    assert expected == pytest.approx(snr, rel=1e-3)
    assert result["photons_on_object"] == pytest.approx(mean_e.mean() / 0.5, rel=1e-4)


def test_the_object_region_is_the_brighter_part(bright: Path, tmp_path: Path, done: Command) -> None:
    done("darken", bright, tmp_path / "dark")
    region = read_frame(tmp_path / "dark" / "object_region.png").pixels_dn > 127
    disc = _light(bright)[:, :, 0] > 0.25 * 10_000
    assert np.mean(region == disc) > 0.999


def test_every_view_is_its_bright_one_scaled_with_noise_of_eq_6(bright: Path, tmp_path: Path, done: Command) -> None:
    result = json.loads(done("--json", "darken", bright, tmp_path / "dark").stdout)
    (bright_views,) = [load_channel(load_set(bright), layout) for layout in channel_layouts(load_set(bright))]
    dark_set = load_set(tmp_path / "dark")
    (dark_views,) = [load_channel(dark_set, layout) for layout in channel_layouts(dark_set)]
    expected = result["scale_e"] * np.maximum(bright_views.electrons.astype(float), 0) + DARK_E
    variance = expected + READ_VARIANCE_E2
    normalised = (dark_views.electrons - expected) / np.sqrt(variance)
    for view in normalised:
        assert abs(view.mean()) < 4 / np.sqrt(view.size)
        deviation = np.sqrt(np.mean(2 + expected / variance**2) / view.size)
        assert np.mean(view**2) == pytest.approx(1, abs=4 * deviation)
    # Noise is drawn anew for each view
    first, second = (view.ravel() for view in normalised[:2])
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(first.size)


def test_views_keep_their_poses_nodes_and_lens(bright: Path, tmp_path: Path, done: Command, edit: Edit) -> None:
    edit(bright, lambda settings: settings["view"][2].update(rt_cam_ref=[0.1, 0, 0, -20.3, 0.1, 0.2], cx_px=90.0))
    done("darken", bright, tmp_path / "dark", "--exposure-s", 0.25)
    before, after = load_set(bright).settings, load_set(tmp_path / "dark").settings
    assert after.view == before.view
    assert after.camera == before.camera
    assert after.reference_view == before.reference_view
    assert after.exposure_s == 0.25


def test_the_dark_camera_is_the_one_described(bright: Path, tmp_path: Path, done: Command) -> None:
    options = {"read-noise-e": 5.0, "dark-current-e-per-s": 1.5, "quantum-efficiency": 0.9}
    done("darken", bright, tmp_path / "dark", *(word for key, value in options.items() for word in (f"--{key}", value)))
    noise = load_set(tmp_path / "dark").noise
    assert (noise.read_noise_e, noise.dark_current_e_per_s, noise.quantum_efficiency) == (5.0, 1.5, 0.9)
    nothing = noise.electrons(read_frame(tmp_path / "dark" / "noise_reference.tiff").pixels_dn)
    assert nothing.mean() == pytest.approx(0.15, abs=4 * 5 / np.sqrt(nothing.size))
    assert nothing.std() == pytest.approx(np.sqrt(25 + 0.15 + 1 / 48), rel=4 / np.sqrt(2 * nothing.size))


def test_colour_stays_colour(make_set: SetMaker, tmp_path: Path, done: Command) -> None:
    light = _scene_light((150, 200), np.random.default_rng(1))
    colours = np.array([1.0, 0.5, 0.2])
    views = [np.rint(100 + 20_000 * light[:, :, np.newaxis] * colours).astype(np.uint16)] * 2
    folder = make_set(views, name="bright")
    scale_e = json.loads(done("--json", "darken", folder, tmp_path / "dark", "--snr", 2).stdout)["scale_e"]
    dark_set = load_set(tmp_path / "dark")
    assert read_frame(dark_set.image_paths[0]).pixels_dn.shape == (150, 200, 3)
    for index, layout in enumerate(channel_layouts(dark_set)):
        electrons = load_channel(dark_set, layout).electrons
        expected = scale_e * _light(folder)[:, :, index].mean() + DARK_E
        deviation = np.sqrt((expected + READ_VARIANCE_E2) / electrons.size)
        assert electrons.mean(dtype=float) == pytest.approx(expected, abs=4 * deviation)
        assert deviation < 0.1 * expected


def test_a_mosaic_stays_one(make_set: SetMaker, tmp_path: Path, done: Command) -> None:
    frame = np.rint(100 + 20_000 * _scene_light((150, 200), np.random.default_rng(1))).astype(np.uint16)
    frame[1::2, 1::2] = 100  # no blue at all
    folder = make_set([frame], name="bright", camera={"mosaic": ["RG", "GB"]})
    done("darken", folder, tmp_path / "dark", "--snr", 5)
    dark_set = load_set(tmp_path / "dark")
    assert dark_set.settings.camera.mosaic == ("RG", "GB")
    means = {layout.name: load_channel(dark_set, layout).electrons.mean() for layout in channel_layouts(dark_set)}
    assert means["blue"] == pytest.approx(DARK_E, abs=4 * np.sqrt(READ_VARIANCE_E2 / (75 * 100)))
    assert min(means["red"], means["green"]) > 1.0


def test_the_flat_field_comes_along(bright: Path, tmp_path: Path, done: Command, edit: Edit) -> None:
    flat = np.linspace(0.5, 1, 150 * 200, dtype=np.float32).reshape(150, 200)
    tifffile.imwrite(bright / "response.tif", flat)
    edit(bright, lambda settings: settings["camera"].update(flat="response.tif"))
    done("darken", bright, tmp_path / "dark")
    np.testing.assert_array_equal(load_set(tmp_path / "dark").flat, flat)


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(bright: Path, tmp_path: Path, done: Command) -> None:
    for name, seed in (("first", 1), ("again", 1), ("other", 2)):
        done("darken", bright, tmp_path / name, "--seed", seed)
    names = [f"view_{column}.tiff" for column in range(3)] + ["noise_reference.tiff"]
    first, again, other = (
        [(tmp_path / run / name).read_bytes() for name in names] for run in ("first", "again", "other")
    )
    assert first == again
    assert all(one != another for one, another in zip(first, other, strict=True))


@pytest.mark.parametrize("names", [("left/frame.tiff", "right/frame.tiff"), ("noise_reference.tif", "flat.tif")])
def test_views_whose_names_would_collide_stay_apart(
    names: tuple[str, str], bright: Path, tmp_path: Path, done: Command, edit: Edit
) -> None:
    level_dn = (20_100, 10_100)
    for name, level in zip(names, level_dn, strict=True):
        (bright / name).parent.mkdir(exist_ok=True)
        write_frame(bright / name, np.full((150, 200), level, np.uint16))
    edit(
        bright, lambda settings: [view.update(image=name) for view, name in zip(settings["view"], names, strict=False)]
    )
    scale_e = json.loads(done("--json", "darken", bright, tmp_path / "dark").stdout)["scale_e"]
    dark_set = load_set(tmp_path / "dark")
    electrons = load_channel(dark_set, channel_layouts(dark_set)[0]).electrons
    for view, level in enumerate(level_dn):
        expected = scale_e * (level - 100) / 2 + DARK_E
        deviation = np.sqrt((expected + READ_VARIANCE_E2) / electrons[view].size)
        assert electrons[view].mean(dtype=float) == pytest.approx(expected, abs=4 * deviation)


def test_pixels_darker_than_the_dark_level_count_as_dark(make_set: SetMaker, tmp_path: Path, done: Command) -> None:
    frame = np.full((60, 80), 20_000, np.uint16)
    frame[:30] = 90  # the offset is 100
    done("darken", make_set([frame], name="bright"), tmp_path / "dark", "--snr", 5)
    dark_set = load_set(tmp_path / "dark")
    (view,) = load_channel(dark_set, channel_layouts(dark_set)[0]).electrons
    deviation = np.sqrt((DARK_E + READ_VARIANCE_E2) / (30 * 80))
    assert view[:30].mean() == pytest.approx(DARK_E, abs=4 * deviation)
    assert view[30:].mean() > 3


@pytest.mark.parametrize("source", [".", "noise_free"])
def test_a_set_is_never_replaced_by_what_is_made_from_it(source: str, scene: Path, faintfield: Command) -> None:
    before = {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()}
    ended = faintfield("darken", scene / source, scene, "--overwrite")
    assert ended.returncode == 1
    assert "OutputExists" in ended.stderr
    assert {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()} == before


def test_without_any_noise_there_is_no_snr_to_reach(bright: Path, tmp_path: Path, faintfield: Command) -> None:
    ended = faintfield("darken", bright, tmp_path / "dark", "--read-noise-e", 0, "--dark-current-e-per-s", 0)
    assert ended.returncode == 1
    assert "BadValue" in ended.stderr
    assert "must both be positive" in ended.stderr
    assert not (tmp_path / "dark").exists()
