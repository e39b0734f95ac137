"""Results as they were first written: files that others read stay the same, key by key."""

from pathlib import Path

import msgspec
import pytest

from faintfield.pipelines.formats.files import write_json
from faintfield.pipelines.formats.results.figures import Metrics, Overview
from faintfield.pipelines.formats.results.geometry import GeometryRecord
from faintfield.pipelines.formats.results.noise import NoiseRecord
from faintfield.pipelines.formats.results.records import DepthMapFileRecord, PlaneFileRecord, ReconstructionRecord
from faintfield.pipelines.formats.results.surface import SurfaceFileRecord
from tests.pipelines.conftest import Command
from tests.pipelines.forms import GOLDEN as GOLDEN
from tests.pipelines.forms import form_of_result
from tests.pipelines.surfaces import FOUND_CONFIDENCE, Searches

# By the beginning of the file's name.
KINDS: dict[str, type[msgspec.Struct]] = {
    "noise": NoiseRecord,
    "geometry": GeometryRecord,
    "reconstruction": ReconstructionRecord,
    "plane": PlaneFileRecord,
    "depth_map": DepthMapFileRecord,
    "metrics": Metrics,
    "overview": Overview,
    "surface": SurfaceFileRecord,
}

PAIR = ("--depth-mm", 500, "--depth-mm", 700)
SWEEP = ("--sweep-mm", "400:800:5", "--method", "backprojection")

# Options that make results from the small scene, and the golden files of the same form.
FRESH: dict[str, tuple[tuple[object, ...], tuple[str, ...]]] = {
    "PMLEM": ((*PAIR, "--prior", "tv"), ("reconstruction_pmlem", "plane_pmlem")),
    "learned prior": (PAIR, ("reconstruction_prior", "plane_prior", "metrics_set", "overview_set")),
    "one-step-late": (("--depth-mm", 500, "--method", "pmlem-osl"), ("reconstruction_pmlem-osl",)),
    "sweep": (SWEEP, ("reconstruction_sweep",)),
    "depth map": ((*SWEEP, "--depth-map"), ("depth_map_sweep",)),
    "auto": (("--depth-mm", "auto", "--prior", "tv"), ("reconstruction_auto",)),
}


@pytest.mark.parametrize("path", [pytest.param(path, id=path.stem) for path in sorted(GOLDEN.iterdir())])
def test_golden_file_is_written_as_it_was_read(path: Path, tmp_path: Path) -> None:
    kind = next(kind for name, kind in KINDS.items() if path.name.startswith(name))
    write_json(tmp_path / path.name, msgspec.json.decode(path.read_bytes(), type=kind))
    assert (tmp_path / path.name).read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    "call", [pytest.param(call, marks=[] if call == "learned prior" else [pytest.mark.deep]) for call in FRESH]
)
def test_fresh_results_have_the_form_of_golden_ones(
    call: str, seen: Searches, bright_scene: Path, tmp_path: Path, done: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("faintfield.pipelines.reconstruction.depth.depth_map.SURE", 0.9 * FOUND_CONFIDENCE)
    options, names = FRESH[call]
    done("reconstruct", bright_scene, "--out", tmp_path, *options)
    for name in names:
        kind = name.rpartition("_")[0]
        file = "plane_00500.0.json" if kind == "plane" else f"{kind}.json"
        assert form_of_result(tmp_path / file) == form_of_result(GOLDEN / f"{name}.json"), name
