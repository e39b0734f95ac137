"""Sets of noise: frames grouped into series, and `noise.json` with its maps as the noise of an elemental set."""

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.results.noise import NoiseFrame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.noise_set import NoiseSet, group_frames

type SetMaker = Callable[..., Path]

FITTED = {
    "offset_dn": {"value": 100.0, "se": 0.1},
    "gain_dn_per_e": {"value": 2.0, "se": 0.01},
    "read_noise_e": {"value": 3.0, "se": 0.02},
    "dark_current_e_per_s": {"value": 0.2, "se": 0.01},
}


class TestNoiseJson:
    """`noise = "noise.json"`: what `faintfield noise` found, with its maps."""

    @pytest.fixture
    def folder(self, make_set: SetMaker, grey_images: Sequence[NDArray[np.uint16]]) -> Path:
        folder = make_set(grey_images, noise="noise.json")
        self.write(folder)
        return folder

    @staticmethod
    def write(folder: Path, **changes: Any) -> None:
        (folder / "noise.json").write_text(json.dumps(FITTED | changes))

    def test_its_values_become_the_model(self, folder: Path) -> None:
        self.write(folder, quantum_efficiency=0.5, saturation_dn={"value": 4095.0})
        noise = load_set(folder).noise
        assert (noise.offset_dn, noise.gain_dn_per_e, noise.read_noise_e) == (100.0, 2.0, 3.0)
        assert (noise.dark_current_e_per_s, noise.quantum_efficiency, noise.saturation_dn) == (0.2, 0.5, 4095.0)
        assert not load_set(folder).offset_from_files

    def test_a_value_that_could_not_be_identified_is_refused_with_the_reason(self, folder: Path) -> None:
        self.write(folder, read_noise_e={"value": None, "why": "one dark frame only"})
        with pytest.raises(BadValue, match=r"read_noise_e is not known \(one dark frame only\)"):
            load_set(folder)

    def test_an_unknown_dark_current_is_taken_for_none_and_said(
        self, folder: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        self.write(folder, dark_current_e_per_s={"value": None, "why": "all exposures are equally long"})
        assert load_set(folder).noise.dark_current_e_per_s == 0.0
        assert (
            "dark_current_e_per_s is not known (all exposures are equally long); 0 is taken" in capsys.readouterr().err
        )

    def test_maps_beside_it_take_the_place_of_its_numbers(self, folder: Path) -> None:
        offset_dn = np.arange(192.0).reshape(12, 16)
        np.savez(folder / "noise_maps.npz", offset_dn=offset_dn, other=np.zeros(3))
        noise = load_set(folder).noise
        np.testing.assert_array_equal(noise.offset_dn, offset_dn)
        assert noise.gain_dn_per_e == 2.0

    def test_hot_and_masked_pixels_are_unusable(self, folder: Path) -> None:
        self.write(folder, hot_pixels=[[3, 15], [11, 0]])
        mask = np.zeros((12, 16), bool)
        mask[5, 6] = True
        np.savez(folder / "noise_maps.npz", mask=mask)
        unusable = load_set(folder).unusable
        assert unusable is not None
        assert np.argwhere(unusable).tolist() == [[3, 15], [5, 6], [11, 0]]

    @pytest.mark.parametrize("pixel", [[12, 0], [-1, 0]])
    def test_hot_pixels_outside_the_sensor_are_refused(self, folder: Path, pixel: list[int]) -> None:
        self.write(folder, hot_pixels=[[1, 1], pixel])
        with pytest.raises(BadValue, match=rf"hot pixel \[{pixel[0]}, {pixel[1]}\] is not one of"):
            load_set(folder)

    @pytest.mark.parametrize(
        ("content", "words"),
        [
            ("{", "is not the result"),
            (json.dumps(FITTED | {"gain_dn_per_e": {"value": -2.0}}), "gain_dn_per_e"),
        ],
    )
    def test_what_is_no_noise_result_is_refused(self, folder: Path, content: str, words: str) -> None:
        (folder / "noise.json").write_text(content)
        with pytest.raises(BadValue, match=rf"(noise\.json|elemental\.toml): .*{words}"):
            load_set(folder)

    @pytest.mark.parametrize("content", [b"PK\x03\x04 no more"])
    def test_maps_that_cannot_be_read_are_refused(self, folder: Path, content: bytes) -> None:
        (folder / "noise_maps.npz").write_bytes(content)
        with pytest.raises(BadValue, match=r"noise_maps\.npz: cannot be read"):
            load_set(folder)

    def test_maps_are_never_unpickled(self, folder: Path) -> None:
        np.savez(folder / "noise_maps.npz", offset_dn=np.array({"a": 1}, object), allow_pickle=True)
        with pytest.raises(BadValue, match=r"noise_maps\.npz: cannot be read"):
            load_set(folder)

    @pytest.mark.parametrize("name", ["offset_dn"])
    def test_maps_of_another_sensor_are_refused(self, folder: Path, name: str) -> None:
        maps: dict[str, Any] = {name: np.ones((16, 12), bool)}
        np.savez(folder / "noise_maps.npz", **maps)
        with pytest.raises(BadValue, match=rf"{name} has shape \(16, 12\), expected is \(12, 16\)"):
            load_set(folder)

    def test_it_and_its_maps_count_among_the_inputs(self, folder: Path) -> None:
        np.savez(folder / "noise_maps.npz", offset_dn=np.zeros((12, 16)))
        hashes = load_set(folder).input_hashes()
        assert set(hashes) == {"elemental.toml", "noise.json", "noise_maps.npz", "view_0.tiff", "view_1.tiff"}
        for name, found in hashes.items():
            assert found == hashlib.sha256((folder / name).read_bytes()).hexdigest()


def grouped(warmth: list[float | None], doubling_k: float | None = None) -> list[tuple[list[int], float | None, float]]:
    """Return the indices of the frames of each series of darks, its temperature and its factor."""
    frames = [NoiseFrame(f"{k}.tiff", "dark", 1.0, temperature_c=it) for k, it in enumerate(warmth)]
    flat = NoiseFrame("flat.tiff", "flat", 0.1, temperature_c=20.0)
    groups = group_frames(Path(), NoiseSet(1, [*frames, flat], dark_current_doubling_k=doubling_k))
    return [
        ([int(path.stem) for path in paths], one.temperature_c, one.dark_factor)
        for one, paths in groups.items()
        if one.kind == "dark"
    ]


@pytest.mark.parametrize(
    ("warmth", "series"),
    [
        ([20.0, 20.5, 20.2], [[0, 1, 2]]),
        ([30.0, 10.0, 10.2, 30.1], [[1, 2], [0, 3]]),
        ([20.0, 20.4, 20.8, 21.2], [[0, 1, 2, 3]]),
        ([20.0 + 0.4 * k for k in range(9)], [[0, 1, 2, 3, 4, 5], [6, 7, 8]]),
        ([10.0, None, 12.0, None], [[1, 3], [0], [2]]),
        ([None, None], [[0, 1]]),
    ],
)
def test_darks_of_one_exposure_are_apart_where_their_temperatures_are(
    warmth: list[float | None], series: list[list[int]]
) -> None:
    assert [indices for indices, _, _ in grouped(warmth)] == series


def test_each_series_has_the_dark_current_of_its_temperature() -> None:
    """The mean of 5 frames is 18 °C: 8 K are two doublings."""
    found = grouped([10.0, 10.0, 26.0, 24.0], 4.0)
    assert [factor for _, _, factor in found] == pytest.approx([0.25, 2**1.5, 4.0])
    assert [warmth for _, warmth, _ in found] == [10.0, 24.0, 26.0]
    assert [warmth for _, warmth, _ in grouped([20.0, 20.2], 4.0)] == [None], "steady: no name of its own"
