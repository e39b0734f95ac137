"""`reconstruct --prior` on colours: each knows the light of the others, and only one is in memory at a time."""

import json
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.reconstruction import sweep, tasks
from faintfield.pipelines.reconstruction.channels import ChannelLayout, channel_layouts, load_channel
from faintfield.pipelines.reconstruction.joint import solve_together
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.pipelines.reconstruction.penalised import Objective, solve_pmlem
from faintfield.pipelines.reconstruction.planes import solve
from faintfield.pipelines.reconstruction.prior import with_prior
from faintfield.pipelines.reconstruction.solutions import Settings
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.prior.evidence import Evidence
from faintfield.recon.prior.patches import patch_candidates
from faintfield.recon.solver.data_fit import SceneProblem
from tests.pipelines.conftest import Command, drawing_nothing

pytestmark = pytest.mark.usefixtures("undrawn")


SIZE = ("--size-px", 64, 48, "--rows", 3, "--columns", 3)
NEAR = ("--depth-mm", 500)
QUICK = ("--passes", 2, "--penalty-weight", 2)
PATCHES = ("--prior", "patches")


@pytest.fixture(scope="module")
def colour_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small set of a Bayer camera, to be read only."""
    folder = tmp_path_factory.mktemp("colour") / "scene"
    assert run([str(word) for word in ("simulate", folder, *SIZE, "--colour", "bayer", "--snr", 1)]) == 0
    return folder


type Readings = list[tuple[str, list[str]]]


@pytest.fixture(scope="module")
def colour_plane(colour_set: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Readings]:
    """A plane by patches, and its colours in the order in which they were read, each with those still in memory."""
    out, read = tmp_path_factory.mktemp("whole"), list[tuple[str, list[str]]]()
    alive: list[tuple[str, weakref.ref[ElementalImages]]] = []

    def watched(elemental_set: ElementalSet, layout: ChannelLayout, *allocate: Any) -> ElementalImages:
        read.append((layout.name, [name for name, images in alive if images() is not None]))
        images = load_channel(elemental_set, layout, *allocate)
        alive.append((layout.name, weakref.ref(images)))
        return images

    with pytest.MonkeyPatch.context() as patch, drawing_nothing():
        patch.setattr(sweep, "load_channel", watched)
        words = ("reconstruct", colour_set, *NEAR, *QUICK, *PATCHES, "--out", out)
        assert run([str(word) for word in words]) == 0
    return out, read


def _planes(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("plane_*")}


def _by_hand(folder: Path, depth_mm: float, settings: Settings) -> list[Image]:
    """Each colour of a plane by the prior, with the sum of the other colours by total variation."""
    elemental_set = load_set(folder)
    objectives, first = [], []
    for layout in channel_layouts(elemental_set):
        images = load_channel(elemental_set, layout)
        operator = OperatorFactory(elemental_set, layout, images).at(depth_mm, plane_grid(elemental_set, depth_mm))
        objectives.append(Objective.of(SceneProblem(operator, images), settings))
        first.append(solve_pmlem(objectives[-1], settings))
    red, green, blue = (one.plane for (one,) in first)
    others = [green + blue, red + blue, red + green]
    return [
        with_prior(objective, one, settings, others=light)[0].plane
        for objective, one, light in zip(objectives, first, others, strict=True)
    ]


def test_each_colour_begins_with_sum_of_others(
    colour_set: Path, colour_plane: tuple[Path, Readings], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Held-out views judge candidates that know the other colours, too."""
    judged: list[Evidence] = []

    def watched(evidence: Evidence) -> dict[str, Image]:
        judged.append(evidence)
        return patch_candidates(evidence)

    monkeypatch.setattr("faintfield.pipelines.reconstruction.prior.patch_candidates", watched)
    plane = tifffile.imread(colour_plane[0] / "plane_00500.0.tiff")
    expected = _by_hand(colour_set, 500.0, Settings(2.0, 2, prior="patches"))
    np.testing.assert_allclose(np.moveaxis(plane, -1, 0), expected, atol=1e-4)
    records = json.loads((colour_plane[0] / "reconstruction.json").read_text())["planes"]
    assert [(record["channel"], record["prior"]["name"]) for record in records] == [
        (channel, "patches") for channel in ("red", "green", "blue")
    ]
    assert len(judged) >= 3 * 3  # colours times two folds and the whole
    assert len({evidence.coverage.sum(dtype=float) for evidence in judged}) == len(judged)
    for evidence in judged:
        assert evidence.others is not None
        assert evidence.others[evidence.coverage > 0].min() > 0


def test_memory_holds_one_colour_at_a_time(colour_plane: tuple[Path, Readings]) -> None:
    assert colour_plane[1] == [(name, []) for name in ("red", "green", "blue", "green", "red")]


def test_joint_planes_begin_with_other_colours(
    colour_set: Path, tmp_path: Path, done: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    light: list[dict[Any, Image]] = []
    begun: list[dict[Any, tuple[Image, Image]]] = []

    def watched(factory: Any, images: Any, grids: Any, methods: Any, settings: Any, pilots: Any = None) -> Any:
        found = solve_together(factory, images, grids, methods, settings, pilots)
        if pilots is None:
            assert settings.prior == "tv"
            light.append({place: one.plane for place, one in found["joint"].items()})
        else:
            begun.append({place: (one.solution.plane, one.others) for place, one in pilots.items()})
        return found

    monkeypatch.setattr(tasks, "solve_together", watched)
    both = (*NEAR, "--depth-mm", 700, "--joint")
    done("reconstruct", colour_set, *both, *QUICK, *PATCHES, "--out", tmp_path)
    assert len(light) == len(begun) == 3
    for own, pilots in zip(light, begun[::-1], strict=True):
        for place, (plane, others) in pilots.items():
            np.testing.assert_array_equal(plane, own[place])
            np.testing.assert_allclose(plane + others, np.sum([one[place] for one in light], axis=0), rtol=1e-5)
    assert len(_planes(tmp_path)) == 2 * 3  # picture, preview and record


def test_interrupted_colour_plane_is_completed_alike(
    colour_set: Path, colour_plane: tuple[Path, Readings], tmp_path: Path, faintfield: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    words = ("reconstruct", colour_set, *NEAR, *QUICK, *PATCHES, "--out", tmp_path)
    calls = []

    def failing(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) == 5:  # three colours by total variation, one by the prior
            raise GeometryMismatch("made up; wait")
        return solve(*arguments)

    monkeypatch.setattr(tasks, "solve", failing)
    assert faintfield(*words).returncode == 1
    assert {path.suffix for path in (tmp_path / ".parts").iterdir()} == {".float32", ".json"}
    assert faintfield(*words).returncode == 0
    assert _planes(tmp_path) == _planes(colour_plane[0])
