"""`noise.json` and its maps as the noise of an elemental set: what is read, and what is refused."""

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.sets.elemental_set import load_set

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

    def test_an_unknown_quantum_efficiency_hinders_nothing(self, folder: Path) -> None:
        self.write(folder, quantum_efficiency={"value": None, "why": "no photons were counted"})
        assert load_set(folder).noise.quantum_efficiency is None

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

    @pytest.mark.parametrize("pixel", [[12, 0], [0, 16], [-1, 0]])
    def test_hot_pixels_outside_the_sensor_are_refused(self, folder: Path, pixel: list[int]) -> None:
        self.write(folder, hot_pixels=[[1, 1], pixel])
        with pytest.raises(BadValue, match=rf"hot pixel \[{pixel[0]}, {pixel[1]}\] is not one of"):
            load_set(folder)

    @pytest.mark.parametrize(
        ("content", "words"),
        [
            ("{", "is not the result"),
            ("[]", "is not the result"),
            ('{"offset_dn": 3}', "is not the result"),
            (json.dumps(FITTED | {"hot_pixels": [[1, 2, 3]]}), "is not the result"),
            (json.dumps(FITTED | {"gain_dn_per_e": {"value": -2.0}}), "gain_dn_per_e"),
        ],
    )
    def test_what_is_no_noise_result_is_refused(self, folder: Path, content: str, words: str) -> None:
        (folder / "noise.json").write_text(content)
        with pytest.raises(BadValue, match=rf"(noise\.json|elemental\.toml): .*{words}"):
            load_set(folder)

    @pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no more", b"nothing like it"])
    def test_maps_that_cannot_be_read_are_refused(self, folder: Path, content: bytes) -> None:
        (folder / "noise_maps.npz").write_bytes(content)
        with pytest.raises(BadValue, match=r"noise_maps\.npz: cannot be read"):
            load_set(folder)

    def test_one_array_is_no_set_of_maps(self, folder: Path) -> None:
        with (folder / "noise_maps.npz").open("wb") as file:
            np.save(file, np.zeros((12, 16)))
        with pytest.raises(BadValue, match=r"noise_maps\.npz: cannot be read"):
            load_set(folder)

    def test_maps_are_never_unpickled(self, folder: Path) -> None:
        np.savez(folder / "noise_maps.npz", offset_dn=np.array({"a": 1}, object), allow_pickle=True)
        with pytest.raises(BadValue, match=r"noise_maps\.npz: cannot be read"):
            load_set(folder)

    @pytest.mark.parametrize("name", ["offset_dn", "mask"])
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
