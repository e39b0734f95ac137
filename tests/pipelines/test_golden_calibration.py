"""noise.json and geometry.json keep their format: golden files of version 0.1.0 are read and written byte for byte."""

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from faintfield.calib.board import Board
from faintfield.pipelines.commands.geometry import geometry
from faintfield.pipelines.commands.noise import noise
from faintfield.pipelines.formats.files import write_json
from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE, GeometryRecord
from faintfield.pipelines.formats.results.noise import NOISE_FILE, NoiseRecord
from faintfield.rig.plan import nominal_poses_rt_cam_ref
from faintfield.rig.simulation.experiment import SimulatedExperiment, paper_experiment
from tests.calib.noise.darkroom import specimen
from tests.pipelines.noise_sets import take_set, write_frames
from tests.simulated_boards import simulate_board_set

GOLDEN = Path(__file__).parent / "golden"
BOARDS = [Board(f"b{index}", 9, 7, 40.0, 29.0, "DICT_4X4_250", 31 * index) for index in range(4)]


def layout(value: Any) -> Any:
    """Return a JSON value with the type of each scalar in its place; keys in their order, lists by their first item.

    A quantity has a value with its error, or none with the reason: which of the two is a matter of the frames.
    """
    if isinstance(value, dict) and list(value) in (["value", "se", "ci95"], ["value", "why"]):
        assert (value["value"] is None) == ("why" in value)
        return "quantity"
    if isinstance(value, dict):
        return [(key, layout(part)) for key, part in value.items()]
    if isinstance(value, list):
        return [layout(part) for part in value[:1]]
    return type(value).__name__


def check_layout(made: Path, golden: str, *later: str) -> None:
    """The keys of a result, their order, and the types of their values are those of a golden file; some came later."""
    found, wanted = (json.loads(path.read_text()) for path in (made, GOLDEN / golden))
    assert list(found)[-1 - len(later) :] == [*later, "record_sha256"]
    for name in (*later, "record_sha256"):
        del found[name]
    for record in (found, wanted):
        assert all(isinstance(warning, str) for warning in record.pop("warnings", []))
    for plane in found.get("planes", []):
        del plane["fit"], plane["emva1288"]  # came later
    assert layout(found) == layout(wanted)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("noise.json", NoiseRecord), ("noise_of_a_mosaic.json", NoiseRecord), ("geometry.json", GeometryRecord)],
)
def test_a_golden_file_is_written_as_it_was_read(name: str, kind: type[msgspec.Struct], tmp_path: Path) -> None:
    content = (GOLDEN / name).read_bytes()
    write_json(tmp_path / name, msgspec.json.decode(content, type=kind))
    assert (tmp_path / name).read_bytes() == content


def test_a_new_noise_has_the_layout_of_the_golden_one(tmp_path: Path) -> None:
    chip, rng = specimen(1, hot_fraction=0.005, prnu=0.01)
    noise(write_frames(tmp_path, take_set(chip, rng, photons=(4000.0, 20000.0)), saturation_dn=65535.0))
    check_layout(tmp_path / NOISE_FILE, "noise.json", "fit", "emva1288")


def test_a_new_noise_of_a_mosaic_has_the_layout_of_the_golden_one(tmp_path: Path) -> None:
    chip, rng = specimen(4, shape=(96, 96))
    chip.offset_dn[1::2, 0::2] += 50
    noise(write_frames(tmp_path, take_set(chip, rng, photons=(10000.0,)), mosaic=["RG", "GB"]))
    check_layout(tmp_path / NOISE_FILE, "noise_of_a_mosaic.json")


def test_a_new_geometry_has_the_layout_of_the_golden_one(tmp_path: Path) -> None:
    paper = paper_experiment(320, 240)
    experiment = SimulatedExperiment(paper.planes, paper.optics, paper.sensor, 3, 3, 100.0)
    poses = np.array(nominal_poses_rt_cam_ref(3, 3, 100.0))
    simulate_board_set(tmp_path, experiment, poses, BOARDS, np.random.default_rng(1))
    geometry(tmp_path)
    check_layout(tmp_path / GEOMETRY_FILE, "geometry.json", "sha256")
