"""Commands run in this process, sets made by hand, and one small simulated scene that tests share."""

import os
import shutil
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numpy as np
import pytest
import tomli_w
from numpy.typing import NDArray

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.image_files import encoded, write_frame
from faintfield.pipelines.reconstruction import penalised, surface, surface_depths, surface_files
from faintfield.recon.surface.estimate import SurfaceEstimate
from tests.pipelines.surfaces import Searches, found_at_once

type Command = Callable[..., CompletedProcess[str]]
type SetMaker = Callable[..., Path]
type Edit = Callable[[Path, Callable[[dict[str, Any]], object]], Path]

SMALL = ("--size-px", 96, 72, "--rows", 3, "--columns", 3)


@pytest.fixture
def faintfield(capfd: pytest.CaptureFixture[str]) -> Command:
    """Run one command in this process; what decoders print past Python counts as its standard error, too."""

    def call(*arguments: object) -> CompletedProcess[str]:
        words = [str(argument) for argument in arguments]
        capfd.readouterr()
        code = run(words)
        said = capfd.readouterr()
        return CompletedProcess(words, code, said.out, said.err)

    return call


@pytest.fixture
def done(faintfield: Command) -> Command:
    """Run one command that must end well."""

    def call(*arguments: object) -> CompletedProcess[str]:
        ended = faintfield(*arguments)
        assert ended.returncode == 0, ended.stderr
        return ended

    return call


@pytest.fixture(scope="session")
def simulated_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small dark set with its truth, to be read only."""
    folder = tmp_path_factory.mktemp("simulated") / "scene"
    assert run([str(word) for word in ("simulate", folder, *SMALL)]) == 0
    return folder


@pytest.fixture
def scene(simulated_scene: Path, tmp_path: Path) -> Path:
    """A copy of the small dark set that a test may change."""
    return Path(shutil.copytree(simulated_scene, tmp_path / "scene"))


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Searches:
    """Replace what is slow: the search for depths, σ, refinement and pictures; return what the search is given."""
    given: Searches = []

    def search(views: Any, inverse_depths: NDArray[np.float64], nodes: NDArray[np.intp]) -> SurfaceEstimate:
        given.append((views, inverse_depths, nodes))
        return found_at_once(views)

    preview = encoded(np.zeros((4, 4), np.uint8), ".png")
    monkeypatch.setattr(surface_depths, "estimate_surface", search)
    monkeypatch.setattr(surface_files, "map_picture", lambda *_: preview)
    monkeypatch.setattr(surface, "refined", lambda operator, images, plane: plane)
    monkeypatch.setattr(penalised, "standard_deviation", lambda local, *_: np.ones_like(local.plane))
    monkeypatch.setattr(surface_files, "render_parallax", lambda *_: [np.zeros((4, 4), np.uint8)] * 2)
    return given


@pytest.fixture(scope="session")
def small_options() -> tuple[object, ...]:
    """The options that make `simulate` fast."""
    return SMALL


@pytest.fixture
def edit() -> Edit:
    """Change the settings of a set in place."""

    def change(folder: Path, how: Callable[[dict[str, Any]], object]) -> Path:
        path = folder / "elemental.toml"
        settings = tomllib.loads(path.read_text())
        how(settings)
        path.write_text(tomli_w.dumps(settings))
        return path

    return change


@pytest.fixture
def make_set(tmp_path: Path) -> SetMaker:
    """Make a set by hand from one image (row, column[, colour]) per view, its nodes in one row, 10 mm apart."""

    def make(
        images: Sequence[NDArray[Any]],
        *,
        name: str = "by-hand",
        noise: dict[str, Any] | str | None = None,
        camera: dict[str, Any] | None = None,
        exposure_s: float = 0.5,
    ) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        height, width = images[0].shape[:2]
        views = []
        for column, image in enumerate(images):
            write_frame(folder / f"view_{column}.tiff", image)
            pose = [0.0, 0.0, 0.0, -10.0 * column, 0.0, 0.0]
            views.append({"image": f"view_{column}.tiff", "rt_cam_ref": pose, "node": [0, column]})
        lens = {"fx_px": 50.0, "fy_px": 50.0, "cx_px": (width - 1) / 2, "cy_px": (height - 1) / 2}
        settings = {
            "format": 1,
            "exposure_s": exposure_s,
            "reference_view": 0,
            "camera": {"size_px": [width, height], **lens, **(camera or {})},
            "noise": noise or {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0},
            "view": views,
        }
        (folder / "elemental.toml").write_text(tomli_w.dumps(settings))
        return folder

    return make


@pytest.fixture
def grey_images() -> list[NDArray[np.uint16]]:
    """Two small views of no scene in particular."""
    return list(np.random.default_rng(20110919).integers(100, 2000, (2, 12, 16)).astype(np.uint16))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real data that is not part of the project."""
    place = os.environ.get("FAINTFIELD_DATA")
    if not place:
        pytest.skip("FAINTFIELD_DATA does not name the folder of real data")
    return Path(place)
