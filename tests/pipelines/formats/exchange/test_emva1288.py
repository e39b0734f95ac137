"""EMVA 1288 data: imported, exported, and measured up to saturation as the standard has them."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from faintfield.calib.estimate import Estimate
from faintfield.pipelines.commands.exports import export_emva1288
from faintfield.pipelines.commands.imports import import_emva1288
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.exchange.emva1288 import read_descriptor
from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.noise_set import load_noise_set
from tests.calib.noise.darkroom import expose, specimen
from tests.pipelines.noise_sets import measure_sensor, take_set, write_frames

DESCRIPTOR = """# a comment
v 4.0
n 12 64 64
b 100000000,0 1000.0
i images\\b_0.png
i images\\b_1.png
b 200000000.0 6000.0
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
    for index, (t, photons) in enumerate(((0.1, 1000.0), (0.1, 1000.0), (0.2, 6000.0), (0.2, 6000.0))):
        cv2.imwrite(str(folder / "images" / f"b_{index}.png"), expose(chip, t, rng, photons))
    for index, t in enumerate((0.1, 0.1, 30.0, 30.0)):
        cv2.imwrite(str(folder / "images" / f"d_{index}.png"), expose(chip, t, rng))
    path = folder / "descriptor.txt"
    path.write_text(DESCRIPTOR)
    return path


def test_reference_data_become_a_noise_set(tmp_path: Path) -> None:
    """Inputs are recorded by the paths that the descriptor states: names may repeat from folder to folder."""
    descriptor = write_data(tmp_path / "data")
    (tmp_path / "data" / "images" / "d_0.png").rename(tmp_path / "data" / "d_1.png")
    descriptor.write_text(DESCRIPTOR.replace("images\\d_0.png", "d_1.png"))
    assert import_emva1288(descriptor, tmp_path / "set").frames == 8
    noise_set = load_noise_set(tmp_path / "set")
    settings = noise_set.settings
    assert noise_set.folder == tmp_path / "set"
    assert settings.saturation_dn == 4095
    flats = [(frame.exposure_s, frame.level, frame.photons) for frame in settings.frame if frame.kind == "flat"]
    assert flats == [(0.1, 0, 1000.0)] * 2 + [(0.2, 1, 6000.0)] * 2
    assert [frame.exposure_s for frame in settings.frame if frame.kind == "dark"] == [0.1, 0.1, 30.0, 30.0]
    measured = measure_sensor(tmp_path / "set")
    assert measured.gain_dn_per_e.value == pytest.approx(0.5, rel=0.06)
    assert isinstance(measured.quantum_efficiency, Estimate)
    assert measured.quantum_efficiency.value == pytest.approx(0.5, rel=0.06)
    inputs = json.loads((tmp_path / "set" / "provenance.json").read_text())["inputs"]
    assert len(inputs) == 9
    for name, digest in inputs.items():
        assert digest == sha256(tmp_path / "data" / name.replace("\\", "/"))


def test_bad_descriptor_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "descriptor.txt"
    for line, words in (
        ("i images\\b_0.png", "line 1: .*before any"),
        ("bd 1000", "line 1: .*none of v, n, b, d, i"),
        ("d -1", "line 1: .*finite and not negative"),
    ):
        path.write_text(line + "\n")
        with pytest.raises(BadValue, match=words):
            read_descriptor(path)
    path.write_text(DESCRIPTOR)
    with pytest.raises(MissingFile, match=r"b_0\.png"):
        import_emva1288(path, tmp_path / "set")
    assert not (tmp_path / "set").exists()


def write_small_set(folder: Path, **settings: object) -> Path:
    chip, rng = specimen(1, shape=(24, 32))
    # A third is no decimal number; levels come in no order.
    return write_frames(folder, take_set(chip, rng, (1 / 3, 10.0), 2, photons=(9000.0, 1000 / 7)), **settings)


def test_exported_region_is_imported_again(tmp_path: Path) -> None:
    region = {"rows": [4, 20], "columns": [2, 30]}
    source = write_small_set(tmp_path / "set", saturation_dn=4095.0, region=region)
    result = export_emva1288(source, tmp_path / "out")
    assert (result.frames, result.bits, result.size_px) == (8, 12, (28, 16))
    import_emva1288(tmp_path / "out" / "descriptor.txt", tmp_path / "again")
    before, after = load_noise_set(source), load_noise_set(tmp_path / "again")
    assert before.settings.saturation_dn == after.settings.saturation_dn
    copies = after.series
    assert list(before.series) == list(copies)
    for kind, paths in before.series.items():
        for path, copy in zip(paths, copies[kind], strict=True):
            np.testing.assert_array_equal(read_frame(path).pixels_dn[4:20, 2:30], read_frame(copy).pixels_dn)


def test_descriptor_follows_the_standard(tmp_path: Path) -> None:
    """Bright measurements first, exposures in ns; every image lies where its line says."""
    export_emva1288(write_small_set(tmp_path / "set"), tmp_path / "out")
    lines = (tmp_path / "out" / "descriptor.txt").read_text().splitlines()
    assert lines[:3] == ["v 4.0", "n 16 32 24", "b 100000000.0 9000.0"]
    assert lines[5].startswith("b 100000000.0 142.857142857142")
    assert lines[8] == "d 333333000.0"
    images = [line[2:].replace("\\", "/") for line in lines if line.startswith("i ")]
    assert sorted(str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out" / "images").iterdir()) == images
    first = tifffile.imread(tmp_path / "out" / images[0])
    assert np.array_equal(first, tifffile.imread(tmp_path / "set" / "flat_04.tiff"))


def test_flats_without_photons_are_refused_by_name(tmp_path: Path) -> None:
    chip, rng = specimen(1, shape=(24, 32))
    frames = take_set(chip, rng, (1.0,), 2, photons=(500.0,))
    frames[-1] = (frames[-1][0], {name: value for name, value in frames[-1][1].items() if name != "photons"})
    with pytest.raises(BadValue, match=r"flat_03\.tiff: states no photons"):
        export_emva1288(write_frames(tmp_path / "set", frames), tmp_path / "out")
    assert not (tmp_path / "out").exists()
