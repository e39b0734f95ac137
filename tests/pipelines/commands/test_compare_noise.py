"""`faintfield noise --compare`: a camera that is as it was, one that has changed, and one that is another."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy import stats

from faintfield.calib.estimate import Estimate
from faintfield.pipelines.commands.calibration import noise
from faintfield.pipelines.errors import BadValue, MissingFile, WrongSize
from faintfield.pipelines.formats.files import sha256, write_record
from faintfield.pipelines.formats.results.noise import NOISE_FILE, NOISE_MAPS, NoiseRecord, read_noise
from tests.calib.noise.darkroom import Chip, specimen
from tests.pipelines.forms import GOLDEN
from tests.pipelines.noise_sets import measure_sensor, take_set, write_frames


def measure(folder: Path, chip: Chip, seed: int, **settings: Any) -> Path:
    rng = np.random.default_rng(seed)
    measure_sensor(write_frames(folder, take_set(chip, rng, photons=(4000.0, 20000.0)), **settings))
    return folder


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    chip, _ = specimen(1, prnu=0.01, hot_fraction=0.005)
    return measure(tmp_path_factory.mktemp("before"), chip, 10)


def altered(source: Path, folder: Path, **changes: Any) -> Path:
    """A copy of a result with some of its record changed, and its maps."""
    folder.mkdir()
    (folder / NOISE_MAPS).write_bytes((source / NOISE_MAPS).read_bytes())
    write_record(folder / NOISE_FILE, msgspec.structs.replace(read_noise(source / NOISE_FILE), **changes))
    return folder


def test_same_camera_has_not_changed(before: Path, tmp_path: Path) -> None:
    chip, _ = specimen(1, prnu=0.01, hot_fraction=0.005)
    comparison = noise(compare=(before, measure(tmp_path, chip, 11)))
    assert comparison.changed == []
    assert comparison.comparisons > 15
    sigmas = [abs(quantity.sigma) for quantity in comparison.quantities if quantity.sigma is not None]
    assert np.mean(np.array(sigmas) < 1.96) > 0.8
    assert comparison.comparisons == len(sigmas) + len(comparison.maps)
    # With m comparisons at 5 % together, each has 5 %/m: two-sided, by Bonferroni
    assert comparison.limit_sigma == pytest.approx(stats.norm.isf(0.025 / comparison.comparisons))
    (offsets,) = comparison.maps
    assert offsets.rms_dn == pytest.approx(offsets.expected_dn, rel=0.1)
    hot = comparison.pixels[0]
    assert hot.kind == "hot"
    assert hot.both > 10
    assert hot.only_first + hot.only_second <= 3


def test_each_change_is_found_alone(before: Path, tmp_path: Path) -> None:
    """Another gain, offsets that have moved, and new hot pixels."""
    chip, _ = specimen(1, prnu=0.01, hot_fraction=0.005, gain_dn_per_e=2.1)
    chip.offset_dn[:32] += np.random.default_rng(5).normal(0, 3, (32, 64))
    chip.dark_current_e_per_s[10, 10:20] += 20
    later = measure(tmp_path, chip, 12)
    comparison = noise(compare=(before / NOISE_FILE, later))
    assert {"gain_dn_per_e", "offset_dn map"} <= set(comparison.changed)
    (offsets,) = comparison.maps
    assert offsets.verdict == "changed"
    # Maps are posterior means: of what has moved they show the share that the frames, not the prior, determine
    shown = 1 - np.median(np.load(later / NOISE_MAPS)["offset_variance_dn2"]) / (3.0**2 + 3.0**2 / 2)
    assert offsets.rms_dn == pytest.approx(np.hypot(offsets.expected_dn or 0, shown * 3 / np.sqrt(2)), rel=0.1)
    assert comparison.pixels[0].only_second >= 9
    assert not {"prnu", "quantum_efficiency", "read_noise_e"} & set(comparison.changed)


def of_a_mosaic(folder: Path, seed: int, **changes: Any) -> Path:
    """The golden record of a mosaic with a map of random offsets, and the second green changed."""
    golden = msgspec.json.decode((GOLDEN / "noise_of_a_mosaic.json").read_bytes(), type=NoiseRecord)
    assert golden.size_px is not None
    assert golden.planes
    planes = [msgspec.structs.replace(plane, **changes) if plane.phase == (1, 0) else plane for plane in golden.planes]
    shape = golden.size_px[::-1]
    folder.mkdir()
    offset = np.random.default_rng(1).normal(100, 1, shape) + np.random.default_rng(seed).normal(0, 0.1, shape)
    offset[1::2, 0::2] += 50 * (seed - 1)
    variance, mask = np.full(shape, 0.01), np.zeros(shape, bool)
    np.savez(folder / NOISE_MAPS, offset_dn=offset, offset_variance_dn2=variance, mask=mask)
    record = msgspec.structs.replace(golden, planes=planes, maps_sha256=sha256(folder / NOISE_MAPS))
    write_record(folder / NOISE_FILE, record)
    return folder


def test_planes_of_a_mosaic_are_compared_separately(tmp_path: Path) -> None:
    """A step of one plane's offsets is no change of its map."""
    first = of_a_mosaic(tmp_path / "a", 1)
    moved = of_a_mosaic(tmp_path / "b", 2, offset_dn=Estimate(500.0, 0.1, (499.8, 500.2)))
    comparison = noise(compare=(first, moved))
    assert comparison.changed == ["G_r1c0: offset_dn"]
    assert [plane_map.plane for plane_map in comparison.maps] == ["R_r0c0", "G_r0c1", "G_r1c0", "B_r1c1"]
    assert {plane_map.verdict for plane_map in comparison.maps} == {"unchanged"}
    assert [plane_map.rms_dn for plane_map in comparison.maps] == pytest.approx([np.hypot(0.1, 0.1)] * 4, rel=0.1)


def test_other_cameras_are_refused_by_name(before: Path, tmp_path: Path) -> None:
    wide = altered(before, tmp_path / "wide", size_px=(128, 64))
    with pytest.raises(WrongSize, match=r"wide.*128 x 64 px.*64 x 64 px"):
        noise(compare=(before, wide))
    coloured = altered(before, tmp_path / "coloured", mosaic=("RG", "GB"))
    with pytest.raises(BadValue, match=r"coloured.*colour filters RG/GB.*none"):
        noise(compare=(before, coloured))
    with pytest.raises(MissingFile):
        noise(compare=(before, tmp_path / "nowhere"))
    with pytest.raises(BadValue, match=NOISE_MAPS):
        noise(compare=(before, altered(before, tmp_path / "other", maps_sha256=sha256(before / NOISE_FILE))))
    (coloured / NOISE_MAPS).unlink()
    (offsets,) = noise(compare=(coloured, coloured)).maps
    assert offsets.verdict == "not comparable"
    assert "no offset map" in (offsets.why or "")
