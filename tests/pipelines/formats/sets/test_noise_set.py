"""Sets of noise: series of frames, warnings about their temperatures, and `noise.json` with its maps in a set."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.estimate import Estimate
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.results.noise import NoiseFrame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.noise_set import (
    NoiseSet,
    group_frames,
    load_noise_set,
)
from faintfield.rig.plan import StepKind
from faintfield.rig.session.session import taken_frames
from faintfield.rig.simulation.lab import SimulatedCamera, SimulatedLab
from faintfield.rig.simulation.optics import SimulatedSensor
from tests.calib.noise.darkroom import specimen
from tests.pipelines.by_hand import FITTED, write_fitted_noise
from tests.pipelines.conftest import SetMaker
from tests.pipelines.noise_sets import measure_sensor, take_set, write_frames
from tests.pipelines.sessions import captured, rig_toml


class TestNoiseJson:
    """`noise = "noise.json"`: what `faintfield noise` found, with its maps."""

    @pytest.fixture
    def folder(self, make_set: SetMaker, grey_images: Sequence[NDArray[np.uint16]]) -> Path:
        folder = make_set(grey_images, noise="noise.json")
        write_fitted_noise(folder, hot_pixels=[[3, 15], [11, 0]])
        return folder

    def test_unknown_dark_current_counts_as_zero(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        changes: dict[str, Any] = {"quantum_efficiency": 0.5, "saturation_dn": {"value": 4095.0}}
        changes["dark_current_e_per_s"] = {"value": None, "why": "all exposures are equally long"}
        write_fitted_noise(folder, **changes)
        elemental_set = load_set(folder)
        noise = elemental_set.noise
        assert (noise.offset_dn, noise.gain_dn_per_e, noise.read_noise_e) == (100.0, 2.0, 3.0)
        assert (noise.dark_current_e_per_s, noise.quantum_efficiency, noise.saturation_dn) == (0.0, 0.5, 4095.0)
        assert not elemental_set.offset_from_files
        words = "dark_current_e_per_s is not known (all exposures are equally long); 0 is taken"
        assert words in capsys.readouterr().err

    def test_bad_noise_results_are_refused(self, folder: Path) -> None:
        for content, words in (
            ("{", "is not the result"),
            (json.dumps({"offset_dn": {"value": 10.0}}), "gain_dn_per_e"),
            (json.dumps(FITTED | {"gain_dn_per_e": {"value": -2.0}}), "gain_dn_per_e"),
            (json.dumps(FITTED | {"hot_pixels": [[1, 1], [12, 0]]}), r"hot pixel \[12, 0\] is not one of"),
            (json.dumps(FITTED | {"hot_pixels": [[-1, 0]]}), r"hot pixel \[-1, 0\] is not one of"),
            (json.dumps(FITTED | {"read_noise_e": {"value": None, "why": "x"}}), r"read_noise_e is not known \(x\)"),
        ):
            (folder / "noise.json").write_text(content)
            with pytest.raises(BadValue, match=rf"(noise\.json|elemental\.toml): .*{words}"):
                load_set(folder)
        write_fitted_noise(folder)
        np.savez(folder / "noise_maps.npz", offset_dn=np.ones((16, 12), bool))
        with pytest.raises(BadValue, match=r"offset_dn has shape \(16, 12\), expected is \(12, 16\)"):
            load_set(folder)

    def test_maps_replace_numbers(self, folder: Path) -> None:
        offset_dn, response = np.arange(192.0).reshape(12, 16), np.linspace(0.5, 1.5, 192).reshape(12, 16)
        mask = np.zeros((12, 16), bool)
        mask[5, 6] = True
        np.savez(folder / "noise_maps.npz", offset_dn=offset_dn, relative_response=response, mask=mask, other=[0, 0])
        elemental_set = load_set(folder)
        np.testing.assert_array_equal(elemental_set.noise.offset_dn, offset_dn)
        assert elemental_set.noise.gain_dn_per_e == 2.0
        assert elemental_set.unusable is not None
        assert np.argwhere(elemental_set.unusable).tolist() == [[3, 15], [5, 6], [11, 0]]
        assert elemental_set.flat is not None
        usable = ~elemental_set.unusable
        np.testing.assert_allclose(elemental_set.flat[usable], response[usable], rtol=1e-6)
        names = {"elemental.toml", "noise.json", "noise_maps.npz", "view_0.tiff", "view_1.tiff"}
        assert elemental_set.input_hashes() == {name: sha256(folder / name) for name in names}


def grouped(warmth: list[float | None], doubling_k: float | None = None) -> list[tuple[list[int], float | None, float]]:
    """Return the indices of the frames of each series of darks, its temperature and its factor."""
    frames = [NoiseFrame(f"{k}.tiff", "dark", 1.0, temperature_c=degrees) for k, degrees in enumerate(warmth)]
    flat = NoiseFrame("flat.tiff", "flat", 0.1, temperature_c=20.0)
    groups = group_frames(Path("noise.toml"), NoiseSet(1, [*frames, flat], dark_current_doubling_k=doubling_k))
    return [
        ([int(path.stem) for path in paths], series.temperature_c, series.dark_factor)
        for series, paths in groups.items()
        if series.kind == "dark"
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
def test_darks_are_grouped_by_temperature(warmth: list[float | None], series: list[list[int]]) -> None:
    assert [indices for indices, _, _ in grouped(warmth)] == series


def test_dark_factor_is_that_of_temperature() -> None:
    """The mean of 5 frames is 18 °C: 8 K are two doublings."""
    series = grouped([10.0, 10.0, 26.0, 24.0], 4.0)
    assert [factor for _, _, factor in series] == pytest.approx([0.25, 2**1.5, 4.0])
    assert [warmth for _, warmth, _ in series] == [10.0, 24.0, 26.0]
    assert [warmth for _, warmth, _ in grouped([20.0, 20.2], 4.0)] == [None], "steady: no name of its own"


def test_only_darks_beyond_the_limit_are_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The temperature of the sensor depends on the step and on the frames read before."""
    arrange = SimulatedLab.arrange
    now: list[Any] = ["dark_scene", 0]

    def arranged(lab: SimulatedLab, kind: StepKind, sweep: int) -> None:
        now[:] = [kind, 0]
        arrange(lab, kind, sweep)

    def temperature_c(_: SimulatedCamera) -> float:
        now[1] += 1
        dark = -18.0 + 0.5 * (now[1] <= 2) - 4.5 * (now[1] == 3)
        temperatures_c: dict[str, float] = {"dark_scene": -20.0, "dark": dark, "flat": 10.0}
        return temperatures_c[now[0]]

    with (
        mock.patch.object(SimulatedLab, "arrange", arranged),
        mock.patch.object(SimulatedCamera, "temperature_c", temperature_c),
    ):
        session = captured(tmp_path, rig_toml(["dark_scene", "dark", "flat"], rows=1, columns=2))
    darks = [f"frames/{path.name}" for frame, _, path in taken_frames(session) if frame.kind == "dark"]
    capfd.readouterr()
    record = measure_sensor(session)
    (warning,) = [warning for warning in record.warnings if "away from the scene" in warning]
    assert f"warning: {warning}" in capfd.readouterr().err
    named = ", ".join(darks[:3])
    assert warning.startswith(
        f"3 of 32 dark frames are more than 2 K away from the scene ({named}): "
        "they have -22.5 to -17.5 °C, the 2 frames of the scene -20.0 to -20.0 °C; "
    )
    alone = load_noise_set(write_frames(tmp_path / "set", take_set(*specimen(1))))
    assert not [warning for warning in alone.warnings if "away from the scene" in warning]


def test_simulated_flats_give_efficiency_without_warning(tmp_path: Path) -> None:
    record = measure_sensor(captured(tmp_path, rig_toml(["dark", "flat"], rows=1, columns=1)))
    assert record.warnings == []
    assert isinstance(record.quantum_efficiency, Estimate)
    low, high = record.quantum_efficiency.ci95 or (0.0, 0.0)
    assert low < SimulatedSensor().quantum_efficiency < high
