"""Results as they were first written: files that others read stay the same, key by key."""

from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import msgspec
import pytest

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.results.overview import Overview
from faintfield.pipelines.formats.results.records import (
    DepthMapFileRecord,
    Metrics,
    PlaneFileRecord,
    ReconstructionRecord,
)
from faintfield.pipelines.formats.results.surface import SurfaceFileRecord
from tests.pipelines.forms import form_of_result

type Command = Callable[..., CompletedProcess[str]]

GOLDEN = Path(__file__).parent / "golden"

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

# Options that make a result of the same kind from the small scene, and the name of its file.
FRESH: dict[str, tuple[str, tuple[object, ...]]] = {
    "reconstruction_pmlem": ("reconstruction.json", (*PAIR, "--prior", "tv")),
    "reconstruction_prior": ("reconstruction.json", PAIR),
    "reconstruction_pmlem-osl": ("reconstruction.json", ("--depth-mm", 500, "--method", "pmlem-osl")),
    "reconstruction_sweep": ("reconstruction.json", SWEEP),
    "reconstruction_auto": ("reconstruction.json", ("--depth-mm", "auto", "--prior", "tv")),
    "depth_map_sweep": ("depth_map.json", (*SWEEP, "--depth-map")),
    "plane_pmlem": ("plane_00500.0.json", (*PAIR, "--prior", "tv")),
    "plane_prior": ("plane_00500.0.json", PAIR),
    "metrics_set": ("metrics.json", PAIR),
    "overview_set": ("overview.json", PAIR),
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


@pytest.mark.parametrize("name", FRESH)
def test_a_fresh_result_has_the_form_of_its_golden_file(
    name: str, golden_scene: Path, tmp_path: Path, done: Command
) -> None:
    file, options = FRESH[name]
    done("reconstruct", golden_scene, "--out", tmp_path, *options)
    assert form_of_result(tmp_path / file) == form_of_result(GOLDEN / f"{name}.json")
