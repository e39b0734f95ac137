"""Results as they were first written: files that others read stay the same, key by key."""

from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import msgspec
import pytest

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.files import write_json
from faintfield.pipelines.formats.results.geometry import GeometryRecord
from faintfield.pipelines.formats.results.noise import NoiseRecord
from faintfield.pipelines.formats.results.overview import Overview
from faintfield.pipelines.formats.results.records import (
    DepthMapFileRecord,
    Metrics,
    PlaneFileRecord,
    ReconstructionRecord,
)
from faintfield.pipelines.formats.results.surface import SurfaceFileRecord
from tests.pipelines.forms import GOLDEN as GOLDEN
from tests.pipelines.forms import form_of_result

type Command = Callable[..., CompletedProcess[str]]

# By the first word of the file's name.
KINDS: dict[str, type[msgspec.Struct]] = {
    "reconstruction": ReconstructionRecord,
    "plane": PlaneFileRecord,
    "depth_map": DepthMapFileRecord,
    "metrics": Metrics,
    "overview": Overview,
    "surface": SurfaceFileRecord,
}

PAIR = ("--depth-mm", 500, "--depth-mm", 700)
SWEEP = ("--sweep-mm", "400:800:9", "--method", "backprojection")

# Options that make results from the small scene, and the golden files of the same form.
FRESH: dict[str, tuple[tuple[object, ...], tuple[str, ...]]] = {
    "PMLEM": ((*PAIR, "--prior", "tv"), ("reconstruction_pmlem", "plane_pmlem")),
    "learned prior": (PAIR, ("reconstruction_prior", "plane_prior", "metrics_set", "overview_set")),
    "one-step-late": (("--depth-mm", 500, "--method", "pmlem-osl"), ("reconstruction_pmlem-osl",)),
    "sweep": (SWEEP, ("reconstruction_sweep",)),
    "depth map": ((*SWEEP, "--depth-map"), ("depth_map_sweep",)),
    "auto": (("--depth-mm", "auto", "--prior", "tv"), ("reconstruction_auto",)),
}


def _kinds_of_files() -> list[tuple[Path, type[msgspec.Struct]]]:
    return [(path, kind) for name, kind in KINDS.items() for path in sorted(GOLDEN.glob(f"{name}_*.json"))]


@pytest.mark.parametrize(("path", "kind"), [pytest.param(*pair, id=pair[0].stem) for pair in _kinds_of_files()])
def test_a_result_that_is_read_and_written_again_is_the_same_byte_for_byte(
    path: Path, kind: type[msgspec.Struct]
) -> None:
    content = path.read_bytes()
    record = msgspec.json.decode(content, type=kind)
    assert msgspec.json.format(msgspec.json.encode(record)) + b"\n" == content


def test_every_golden_file_has_a_kind_here_or_in_a_test_of_its_own() -> None:
    others = {"noise.json", "noise_of_a_mosaic.json", "geometry.json"}
    assert {path.name for path in GOLDEN.iterdir()} - others == {path.name for path, _ in _kinds_of_files()}


@pytest.fixture(scope="module")
def golden_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small set with as many views as the golden one, of fewer pixels but with more light."""
    folder = tmp_path_factory.mktemp("golden") / "set"
    assert run([str(word) for word in ("simulate", folder, "--seed", 3, "--size-px", 96, 72, "--snr", 2)]) == 0
    return folder


@pytest.mark.parametrize("call", FRESH)
def test_fresh_results_have_the_form_of_golden_ones(
    call: str, golden_scene: Path, tmp_path: Path, done: Command
) -> None:
    options, names = FRESH[call]
    done("reconstruct", golden_scene, "--out", tmp_path, *options)
    for name in names:
        kind = name.rpartition("_")[0]
        file = "plane_00500.0.json" if kind == "plane" else f"{kind}.json"
        assert form_of_result(tmp_path / file) == form_of_result(GOLDEN / f"{name}.json"), name


@pytest.mark.parametrize(
    ("name", "kind"),
    [("noise.json", NoiseRecord), ("noise_of_a_mosaic.json", NoiseRecord), ("geometry.json", GeometryRecord)],
)
def test_a_golden_file_is_written_as_it_was_read(name: str, kind: type[msgspec.Struct], tmp_path: Path) -> None:
    content = (GOLDEN / name).read_bytes()
    write_json(tmp_path / name, msgspec.json.decode(content, type=kind))
    assert (tmp_path / name).read_bytes() == content
