"""Light of imported pictures: tone curves undone, units, and gain and noise that nobody stated."""

import re
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_file import Noise
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from tests.pipelines.conftest import Command
from tests.pipelines.forms import read_record

EVERY_VALUE = np.arange(256, dtype=np.uint8).reshape(16, 16)


def one_picture(folder: Path, pixels: NDArray[Any], name: str = "a.png") -> Path:
    folder.mkdir()
    assert cv2.imwrite(str(folder / name), pixels)
    return folder


def imported_light(folder: Path) -> tuple[str, NDArray[Any]]:
    """Return the unit of light, and the first picture."""
    elemental_set = load_set(folder)
    return elemental_set.settings.units.light, read_frame(elemental_set.image_paths[0]).pixels_dn


def stated_noise(folder: Path) -> Noise:
    noise = load_set(folder).settings.noise
    assert isinstance(noise, Noise)
    return noise


def test_8_bit_pictures_lose_srgb_curve(tmp_path: Path, done: Command) -> None:
    ended = done("import", "grid", one_picture(tmp_path / "src", EVERY_VALUE), tmp_path / "out")
    assert "8-bit pictures are taken to have the tone curve of sRGB, which is undone; give --linear" in ended.stderr
    unit, picture = imported_light(tmp_path / "out")
    light = picture.ravel()
    assert light.dtype == np.uint16
    assert (light[0], light[255]) == (0, 65535)
    # Points of the standard: the straight part ends at 0.04045, between the values 10 and 11
    for value, share in ((1, 1 / 255 / 12.92), (10, 10 / 255 / 12.92), (11, 0.003347), (64, 0.051269), (128, 0.215861)):
        assert light[value] == pytest.approx(65535 * share, abs=0.6), value
    assert (np.diff(light.astype(int)) > 0).all()
    assert unit == "relative"
    assert "estimated = true" in (tmp_path / "out" / "elemental.toml").read_text()
    # The noise that is assumed is that of rounding
    noise = stated_noise(tmp_path / "out")
    white_step_dn = 65535 * 2.4 / 1.055 / 255  # slope of the curve at white
    dark_step_dn = 65535 / 12.92 / 255
    at_white_dn2 = noise.gain_dn_per_e * 65535 + (noise.gain_dn_per_e * noise.read_noise_e) ** 2
    assert at_white_dn2 == pytest.approx(white_step_dn**2 / 12, rel=0.02)
    assert noise.gain_dn_per_e * noise.read_noise_e == pytest.approx(dark_step_dn / 12**0.5, rel=0.01)


def test_white_is_saturated_with_and_without_curve(tmp_path: Path, done: Command) -> None:
    src = one_picture(tmp_path / "src", EVERY_VALUE)
    for options, saturation_dn in (((), 65535.0), (("--linear",), 255.0)):
        folder = tmp_path / f"out{saturation_dn:.0f}"
        done("import", "grid", src, folder, *options)
        elemental_set = load_set(folder)
        assert elemental_set.noise.saturation_dn == saturation_dn
        valid = load_channel(elemental_set, channel_layouts(elemental_set)[0]).valid
        assert valid is not None
        np.testing.assert_array_equal(valid.ravel(), EVERY_VALUE.ravel() < 255)


def with_gamma(content: bytes, gamma: int) -> bytes:
    """Insert a gAMA chunk after the header of a PNG."""
    chunk = b"gAMA" + struct.pack(">I", gamma)
    whole = struct.pack(">I", 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return content[:33] + whole + content[33:]


def test_png_may_state_linear_values(tmp_path: Path, done: Command) -> None:
    path = one_picture(tmp_path / "src", EVERY_VALUE) / "a.png"
    content = path.read_bytes()
    for gamma, unit, white in ((100_000, "dn", 255), (45_455, "relative", 65535)):
        path.write_bytes(with_gamma(content, gamma))
        words = done("import", "grid", tmp_path / "src", tmp_path / unit).stderr
        found, picture = imported_light(tmp_path / unit)
        assert (found, picture.max()) == (unit, white)
        assert ("curve of sRGB" in words) == (unit == "relative")


def test_16_bit_pictures_are_linear_unless_stated(tmp_path: Path, done: Command) -> None:
    values = np.array([[0, 257, 32896, 65535]] * 4, np.uint16)
    src = one_picture(tmp_path / "src", values)
    done("import", "grid", src, tmp_path / "linear")
    assert imported_light(tmp_path / "linear")[0] == "dn"
    assert (tmp_path / "linear" / "a.png").read_bytes() == (src / "a.png").read_bytes()
    assert load_set(tmp_path / "linear").noise.saturation_dn == 65535.0
    done("import", "grid", src, tmp_path / "curved", "--srgb")
    unit, picture = imported_light(tmp_path / "curved")
    assert unit == "relative"
    # As 8-bit values 0, 1, 128 and 255
    np.testing.assert_array_equal(picture[0], [0, 20, 14146, 65535])
    assert load_set(tmp_path / "curved").image_paths[0].suffix == ".tiff"


def with_exposure(content: bytes, exposure_s: tuple[int, int]) -> bytes:
    """Insert an EXIF segment that states an exposure into a JPEG."""
    directory = struct.pack("<HHHIII", 1, 0x8769, 4, 1, 26, 0)
    exif = struct.pack("<HHHIII", 1, 0x829A, 5, 1, 44, 0) + struct.pack("<II", *exposure_s)
    body = b"Exif\0\0" + b"II*\0" + struct.pack("<I", 8) + directory + exif
    return content[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + content[2:]


def test_exposure_of_photograph_is_from_exif(tmp_path: Path, done: Command) -> None:
    path = one_picture(tmp_path / "src", EVERY_VALUE, "a.jpg") / "a.jpg"
    path.write_bytes(with_exposure(path.read_bytes(), (1, 40)))
    done("import", "grid", tmp_path / "src", tmp_path / "out")
    assert load_set(tmp_path / "out").settings.exposure_s == 0.025
    done("import", "grid", tmp_path / "src", tmp_path / "given", "--exposure-s", 2)
    assert load_set(tmp_path / "given").settings.exposure_s == 2.0


GAIN, READ_E, BLACK_DN = 4.0, 20.0, 600


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """3 x 3 16-bit views of a soft scene that moves by 2 px from node to node, of a sensor with known noise."""
    folder = tmp_path_factory.mktemp("noisy")
    rng = np.random.default_rng(4)
    wide = cv2.GaussianBlur(rng.random((220, 280)), (0, 0), 9)
    wide = 3000 * ((wide - wide.min()) / np.ptp(wide)) ** 2
    for row, column in np.ndindex(3, 3):
        light_e = wide[20 + 2 * row : 180 + 2 * row, 20 + 2 * column : 240 + 2 * column]
        dn = BLACK_DN + GAIN * (rng.poisson(light_e) + rng.normal(0, READ_E, light_e.shape))
        tifffile.imwrite(folder / f"view_r{row}_c{column}.tiff", np.rint(dn).astype(np.uint16))
    return folder


def test_unstated_gain_and_noise_are_estimated(noisy: Path, tmp_path: Path, done: Command) -> None:
    words = done("import", "grid", noisy, tmp_path / "out", "--offset-dn", BLACK_DN).stderr
    noise = stated_noise(tmp_path / "out")
    assert noise.estimated
    assert noise.gain_dn_per_e == pytest.approx(GAIN, rel=0.15)
    assert noise.read_noise_e == pytest.approx(READ_E, rel=0.2)
    assert imported_light(tmp_path / "out")[0] == "dn"
    assert "estimated from the differences of neighbouring views" in words
    assert re.search(r"the variance of a pixel is \S+ · light \+ \S+², in DN$", words, re.MULTILINE)
    record = read_record(tmp_path / "out", "provenance.json")["noise"]
    assert record["how"] == "estimated"
    assert record["gain_dn"]["value"] == noise.gain_dn_per_e
    low, high = record["gain_dn"]["ci95"]
    assert low < noise.gain_dn_per_e < high
    assert record["read_noise_dn"]["value"] == pytest.approx(GAIN * READ_E, rel=0.2)
    assert len(record["mean_dn"]) == len(record["variance_dn2"]) >= 3


def test_stated_noise_stays_beside_estimates(noisy: Path, tmp_path: Path, done: Command) -> None:
    cases = (("--gain-dn-per-e", 4.0, (4.0, READ_E), "electrons"), ("--read-noise-e", 7.0, (GAIN, 7.0), "dn"))
    for option, value, expected, unit in cases:
        done("import", "grid", noisy, tmp_path / unit, "--offset-dn", BLACK_DN, option, value)
        noise = stated_noise(tmp_path / unit)
        assert (noise.gain_dn_per_e, noise.read_noise_e) == pytest.approx(expected, rel=0.15)
        assert (noise.estimated, imported_light(tmp_path / unit)[0]) == (True, unit)
        assert value in (noise.gain_dn_per_e, noise.read_noise_e)


def test_noise_without_evidence_is_assumed_and_announced(tmp_path: Path, done: Command) -> None:
    words = done("import", "grid", one_picture(tmp_path / "src", np.zeros((8, 8), np.uint16)), tmp_path / "out").stderr
    assert "gain and noise are not stated and cannot be estimated (0 blocks of 16 x 16 px" in words
    assert "assumed that the variance of a pixel is 1 · light + 0², in DN; correct [noise] in elemental.toml" in words
    noise = stated_noise(tmp_path / "out")
    assert (noise.gain_dn_per_e, noise.read_noise_e, noise.estimated) == (1.0, 0.0, True)
    assert read_record(tmp_path / "out", "provenance.json")["noise"]["how"] == "assumed"


def test_images_of_colmap_lose_their_curve_alike(tmp_path: Path, done: Command) -> None:
    src = one_picture(tmp_path / "src", EVERY_VALUE)
    (src / "cameras.txt").write_text("1 PINHOLE 16 16 20 20 8 8\n")
    (src / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    for options, unit, white in (((), "relative", 65535), (("--linear",), "dn", 255)):
        done("import", "colmap", src, tmp_path / unit, *options)
        found, picture = imported_light(tmp_path / unit)
        assert (found, picture.max()) == (unit, white)
        assert stated_noise(tmp_path / unit).estimated
