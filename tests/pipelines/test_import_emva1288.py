"""EMVA 1288 descriptor files become noise sets that `faintfield noise` reads."""

import json
from pathlib import Path

import cv2
import pytest

from faintfield.pipelines.cli import run
from faintfield.pipelines.commands.imports.emva1288 import import_emva1288
from faintfield.pipelines.commands.noise import noise
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.exchange.emva1288 import read_descriptor
from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.results.noise_fit import Measured
from faintfield.pipelines.formats.sets.noise_set import load_noise_set
from tests.calib.noise.darkroom import expose, specimen

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
    measured = noise(tmp_path / "set")
    assert measured.gain_dn_per_e.value == pytest.approx(0.5, rel=0.06)
    assert isinstance(measured.quantum_efficiency, Measured)
    assert measured.quantum_efficiency.value == pytest.approx(0.5, rel=0.06)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("i images\\b_0.png", "line 1: .*before any"),
        ("b 100000.0", "line 1: .*give 'b exposure photons'"),
        ("x 1", "line 1: .*none of v, n, b, d, i"),
        ("d soon", "line 1: "),
        ("bd 1000", "line 1: .*none of v, n, b, d, i"),
        ("d nan", "line 1: .*finite and not negative"),
        ("b 1000 inf", "line 1: .*finite and not negative"),
        ("d -1", "line 1: .*finite and not negative"),
        ("v 4.0", "names 0 images"),
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


def test_a_place_that_holds_files_is_left_alone(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    descriptor = write_data(tmp_path / "data")
    assert run(["import", "emva1288", str(descriptor), str(tmp_path / "data")]) == 1
    assert "OutputExists" in capfd.readouterr().err
