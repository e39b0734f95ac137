"""EMVA 1288 data: imported, exported, and measured up to saturation as the standard has them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.calibration.noise import calibrate_sensor, noise_record
from faintfield.pipelines.cli import run
from faintfield.pipelines.commands.exports.emva1288 import export_emva1288
from faintfield.pipelines.commands.imports.emva1288 import import_emva1288
from faintfield.pipelines.errors import BadValue, MissingFile, OutputExists
from faintfield.pipelines.formats.exchange.emva1288 import read_descriptor
from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.noise import NoiseRecord
from faintfield.pipelines.formats.results.noise_fit import Measured
from faintfield.pipelines.formats.sets.noise_set import NoiseSet, group_frames, load_noise_set
from tests.calib.noise.darkroom import expose, specimen
from tests.pipelines.noise_sets import measure_sensor, take_set, write_frames

DESCRIPTOR = """# a comment
v 4.0
n 12 64 64
b 100000000,0 1000.0
i images\\b_0.png
i images\\b_1.png
b 100000000.0 6000.0
i images\\b_2.png
i images\\b_3.png
d 100000000.0
i images\\d_0.png
i images\\d_1.png
d 30000000000.0
i images/d_2.png
i images/d_3.png
"""


def write_data(folder: Path) -> Path:
    chip, rng = specimen(1, gain_dn_per_e=0.5)
    (folder / "images").mkdir(parents=True)
    for index, photons in enumerate((1000.0, 1000.0, 6000.0, 6000.0)):
        cv2.imwrite(str(folder / "images" / f"b_{index}.png"), expose(chip, 0.1, rng, photons))
    for index, t in enumerate((0.1, 0.1, 30.0, 30.0)):
        cv2.imwrite(str(folder / "images" / f"d_{index}.png"), expose(chip, t, rng))
    path = folder / "descriptor.txt"
    path.write_text(DESCRIPTOR)
    return path


def test_reference_data_become_a_noise_set(tmp_path: Path) -> None:
    result = import_emva1288(write_data(tmp_path / "data"), tmp_path / "set")
    assert result["frames"] == 8
    folder, settings = load_noise_set(tmp_path / "set")
    assert folder == tmp_path / "set"
    assert settings.saturation_dn == 4095
    flats = [frame for frame in settings.frame if frame.kind == "flat"]
    assert [(frame.exposure_s, frame.level, frame.photons) for frame in flats] == [
        (0.1, 0, 1000.0),
        (0.1, 0, 1000.0),
        (0.1, 1, 6000.0),
        (0.1, 1, 6000.0),
    ]
    assert [frame.exposure_s for frame in settings.frame if frame.kind == "dark"] == [0.1, 0.1, 30.0, 30.0]
    measured = measure_sensor(tmp_path / "set")
    assert measured.gain_dn_per_e.value == pytest.approx(0.5, rel=0.06)
    assert isinstance(measured.quantum_efficiency, Measured)
    assert measured.quantum_efficiency.value == pytest.approx(0.5, rel=0.06)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("i images\\b_0.png", "line 1: .*before any"),
        ("bd 1000", "line 1: .*none of v, n, b, d, i"),
        ("d -1", "line 1: .*finite and not negative"),
    ],
)
def test_what_is_no_descriptor_is_refused_with_its_line(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "descriptor.txt"
    path.write_text(line + "\n")
    with pytest.raises(BadValue, match=words):
        read_descriptor(path)


def test_all_that_was_read_is_recorded(tmp_path: Path) -> None:
    """By the paths that the descriptor states: names may repeat from folder to folder."""
    descriptor = write_data(tmp_path / "data")
    (tmp_path / "data" / "images" / "d_0.png").rename(tmp_path / "data" / "d_1.png")
    descriptor.write_text(DESCRIPTOR.replace("images\\d_0.png", "d_1.png"))
    import_emva1288(descriptor, tmp_path / "set")
    inputs = json.loads((tmp_path / "set" / "provenance.json").read_text())["inputs"]
    for name, digest in inputs.items():
        assert digest == sha256(tmp_path / "data" / name.replace("\\", "/"))
    assert len(inputs) == 9


def test_a_missing_image_leaves_nothing_behind(tmp_path: Path) -> None:
    descriptor = write_data(tmp_path / "data")
    (tmp_path / "data" / "images" / "d_3.png").unlink()
    with pytest.raises(MissingFile, match=r"d_3\.png"):
        import_emva1288(descriptor, tmp_path / "set")
    assert not (tmp_path / "set").exists()


def frames_of(folder: Path) -> tuple[dict[object, list[np.ndarray]], NoiseSet]:
    """The pixels of every frame, by what its series have in common."""
    folder, settings = load_noise_set(folder)
    series = group_frames(folder, settings)
    return {is_of: [read_frame(path).pixels_dn for path in paths] for is_of, paths in series.items()}, settings


def write_small_set(folder: Path, **settings: object) -> Path:
    chip, rng = specimen(1, shape=(24, 32))
    # A third is no decimal number; levels come in no order.
    return write_frames(folder, take_set(chip, rng, (1 / 3, 10.0), 2, photons=(9000.0, 1000 / 7)), **settings)


def test_what_is_exported_is_imported_again(tmp_path: Path) -> None:
    source = write_small_set(tmp_path / "set", saturation_dn=4095.0)
    result = export_emva1288(source, tmp_path / "out")
    assert (result.frames, result.bits, result.size_px) == (8, 12, (32, 24))
    import_emva1288(tmp_path / "out" / "descriptor.txt", tmp_path / "again")
    (before, settings), (after, again) = frames_of(source), frames_of(tmp_path / "again")
    assert list(before) == list(after)
    assert again.saturation_dn == settings.saturation_dn
    for is_of, images in before.items():
        assert all(np.array_equal(*pair) for pair in zip(images, after[is_of], strict=True))


def test_the_descriptor_is_of_the_standard(tmp_path: Path) -> None:
    """Bright measurements first, exposures in ns; every image lies where its line says."""
    export_emva1288(write_small_set(tmp_path / "set"), tmp_path / "out")
    lines = (tmp_path / "out" / "descriptor.txt").read_text().splitlines()
    assert lines[:3] == ["v 4.0", "n 16 32 24", "b 100000000.0 9000.0"]
    assert lines[5].startswith("b 100000000.0 142.857142857142")
    assert lines[8] == "d 333333000.0"
    named = [line[2:].replace("\\", "/") for line in lines if line.startswith("i ")]
    assert sorted(str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out" / "images").iterdir()) == named
    first = tifffile.imread(tmp_path / "out" / named[0])
    assert np.array_equal(first, tifffile.imread(tmp_path / "set" / "flat_04.tiff"))


def test_only_the_region_in_use_is_exported(tmp_path: Path) -> None:
    region = {"rows": [4, 20], "columns": [2, 30]}
    source = write_small_set(tmp_path / "set", region=region)
    assert export_emva1288(source, tmp_path / "out").size_px == (28, 16)
    import_emva1288(tmp_path / "out" / "descriptor.txt", tmp_path / "again")
    (before, _), (after, _) = frames_of(source), frames_of(tmp_path / "again")
    for is_of, images in before.items():
        assert np.array_equal(images[0][4:20, 2:30], after[is_of][0])


def test_flats_without_photons_are_refused_by_name(tmp_path: Path) -> None:
    chip, rng = specimen(1, shape=(24, 32))
    frames = take_set(chip, rng, (1.0,), 2, photons=(500.0,))
    frames[-1] = (frames[-1][0], {name: it for name, it in frames[-1][1].items() if name != "photons"})
    with pytest.raises(BadValue, match=r"flat_03\.tiff: states no photons"):
        export_emva1288(write_frames(tmp_path / "set", frames), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_earlier_data_are_replaced_only_when_asked(tmp_path: Path) -> None:
    source = write_small_set(tmp_path / "set")
    for command, marked in (("export", "descriptor.txt"), ("import", "noise.toml")):
        read = source if command == "export" else tmp_path / "export" / "descriptor.txt"
        call = [command, "emva1288", str(read), str(tmp_path / command)]
        assert run(call) == 0
        assert run(call) == 1
        (tmp_path / command / "stale").touch()
        assert run([*call, "--overwrite"]) == 0
        assert not (tmp_path / command / "stale").exists()
        assert (tmp_path / command / marked).exists()


def test_what_is_read_is_never_replaced(tmp_path: Path) -> None:
    source = write_small_set(tmp_path / "set")
    (source / "descriptor.txt").touch()
    with pytest.raises(OutputExists):
        export_emva1288(source, source, overwrite=True)
    assert (source / "flat_04.tiff").exists()


@dataclass(frozen=True)
class EmvaCamera:
    """A camera as EMVA 1288 measures it: the exposure varies under one light, up to saturation.

    A charge of Q electrons makes the signal K Q (1 + bend Q / full_e); the offset drifts by a random walk.
    """

    gain_dn_per_e: float = 0.1
    read_noise_e: float = 30.0
    offset_dn: float = 60.0
    full_e: float = 40_000.0
    bend: float = -0.02
    bits: int = 12
    quantum_efficiency: float = 0.5
    dark_current_e_per_s: float = 1000.0
    dsnu_e: float = 5.0
    prnu: float = 0.005
    drift_dn: float = 0.0
    shape: tuple[int, int] = (128, 128)


def write_emva_set(
    folder: Path,
    camera: EmvaCamera,
    rng: np.random.Generator,
    levels: int = 50,
    many: int = 100,
    off: int | None = None,
) -> Path:
    """Write pairs of flats and darks at each exposure, `many` of each at half of saturation; return the descriptor.

    The series of index `off` has twice the noise that it should have.
    """
    (folder / "images").mkdir(parents=True)
    offset_dn = camera.offset_dn + camera.gain_dn_per_e * camera.dsnu_e * rng.standard_normal(camera.shape)
    response = 1 + camera.prnu * rng.standard_normal(camera.shape)
    walk_dn, lines, count = 0.0, ["# simulated", "v 4.0", f"n {camera.bits} {camera.shape[1]} {camera.shape[0]}"], 0

    def expose(charge_e: float, noisier: float) -> NDArray[np.uint16]:
        nonlocal walk_dn
        walk_dn += camera.drift_dn * rng.standard_normal()
        mean = charge_e * response
        charge = mean + noisier * (rng.poisson(mean) - mean + rng.normal(0, camera.read_noise_e, camera.shape))
        dn = camera.gain_dn_per_e * charge * (1 + camera.bend * charge / camera.full_e) + offset_dn + walk_dn
        return np.asarray(np.clip(np.rint(dn), 0, 2**camera.bits - 1), np.uint16)

    for index, share in enumerate(np.linspace(0.02, 1.1, levels)):
        exposure_ns, light_e = 2e7 * share, camera.full_e * share
        dark_e = camera.dark_current_e_per_s * exposure_ns * 1e-9
        frames = many if index == levels // 2 else 2
        photons = light_e / camera.quantum_efficiency
        for line, charge_e in (
            (f"b {exposure_ns:.1f} {photons:.3f}", light_e + dark_e),
            (f"d {exposure_ns:.1f}", dark_e),
        ):
            lines.append(line)
            for _ in range(frames):
                name = f"images/{count:05d}.tif"
                tifffile.imwrite(folder / name, expose(charge_e, 2.0 if index == off and line[0] == "b" else 1.0))
                lines.append("i " + name.replace("/", "\\"))
                count += 1
    path = folder / "descriptor.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def measure(tmp_path: Path, camera: EmvaCamera, seed: int, **how: Any) -> NoiseRecord:
    """Import and measure a simulated set."""
    import_emva1288(write_emva_set(tmp_path / "data", camera, np.random.default_rng(seed), **how), tmp_path / "set")
    return noise_record(calibrate_sensor(*load_noise_set(tmp_path / "set")))


def holds(found: Measured, truth: float) -> bool:
    """Return whether the interval of a quantity holds the truth, or there is none and a reason instead."""
    if found.value is None:
        return bool(found.why)
    assert found.ci95 is not None
    return found.ci95[0] <= truth <= found.ci95[1]


def test_a_series_up_to_saturation_gives_gain_and_read_noise_of_a_camera_that_bends(tmp_path: Path) -> None:
    camera = EmvaCamera()
    found = measure(tmp_path, camera, 1)
    for name, truth in (("gain_dn_per_e", 0.1), ("read_noise_e", 30.0)):
        measured: Measured = getattr(found, name)
        assert measured.value == pytest.approx(truth, rel=0.003), name
        assert holds(measured, truth), name
    assert holds(found.dark_current_e_per_s, camera.dark_current_e_per_s)
    assert found.fit
    assert found.fit.saturation.limit == "ADC"
    assert found.saturation_dn == 4095
    assert sum(one.left_out is not None for one in found.fit.series) == 5
    light_e = np.linspace(0.02, 1.1, 50)[2:44] * camera.full_e
    signal = 0.1 * light_e * (1 + camera.bend * light_e / camera.full_e)
    line = np.polyval(np.polyfit(light_e, signal, 1, w=1 / signal), light_e)
    assert found.fit.linearity_error.value == pytest.approx(np.mean(np.abs(signal / line - 1)), rel=0.02)
    capacity = found.fit.saturation_e.value
    assert capacity is not None
    assert 0.1 * capacity * (1 + camera.bend * capacity / camera.full_e) == pytest.approx(4095 - 60, rel=0.005)


@pytest.mark.deep
@pytest.mark.parametrize("off", [None, 8])
def test_eight_bits_whose_offset_drifts_hold_the_truth_or_are_refused_by_name(tmp_path: Path, off: int | None) -> None:
    camera = EmvaCamera(0.0125, 40.0, 6.0, 18_000.0, bits=8, dsnu_e=10.0, drift_dn=0.03, shape=(48, 48))
    found = measure(tmp_path, camera, 3, levels=20, many=30, off=off)
    assert holds(found.gain_dn_per_e, 0.0125)
    assert holds(found.read_noise_e, 40.0)
    assert holds(found.dark_current_e_per_s, 1000.0)
    if off is not None:
        assert found.gain_dn_per_e.value is None
        assert "at level 8 is +" in str(found.gain_dn_per_e.why)
