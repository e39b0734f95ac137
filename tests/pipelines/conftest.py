"""Commands run in this process, sets made by hand, and the scene and session that all tests share."""

import fcntl
import os
import shutil
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numba
import numpy as np
import pytest
import tomli_w
from matplotlib.figure import Figure
from numpy.typing import NDArray

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.image_files import encoded
from faintfield.pipelines.pages import report_sets, viewer_data
from faintfield.pipelines.pages.page import LOSSLESS, data_uri
from faintfield.pipelines.reconstruction.depth import search as surface_depths
from faintfield.pipelines.reconstruction.options import Options
from faintfield.pipelines.reconstruction.planes import penalised
from faintfield.pipelines.reconstruction.surface import files as surface_files
from faintfield.pipelines.reconstruction.surface import reconstruct as surface
from faintfield.recon.surface.estimate import SurfaceEstimate
from tests.drawings import save_empty
from tests.pipelines.by_hand import View, write_set
from tests.pipelines.sessions import captured, rig_toml, steps_run
from tests.pipelines.surfaces import Searches, found_at_once, write_example

type Command = Callable[..., CompletedProcess[str]]
type SetMaker = Callable[..., Path]
type Edit = Callable[[Path, Callable[[dict[str, Any]], object]], Path]

SMALL = ("--size-px", 96, 72, "--rows", 3, "--columns", 3)
LARGER = ("--size-px", 96, 72, "--rows", 5, "--columns", 5)


@contextmanager
def in_one_thread() -> Iterator[None]:
    """Leave the second core to the second process of the tests; the order of sums depends on the threads."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(numba.config, "NUMBA_NUM_THREADS", 1)
        yield


@pytest.fixture(scope="package", autouse=True)
def one_thread() -> Iterator[None]:
    """All tests of this folder in one thread for each process; those of `recon` use threads."""
    with in_one_thread():
        yield


@pytest.fixture
def faintfield(capfd: pytest.CaptureFixture[str]) -> Command:
    """Run one command in this process; what decoders print past Python counts as its standard error, too."""

    def call(*arguments: object) -> CompletedProcess[str]:
        words = [str(argument) for argument in arguments]
        capfd.readouterr()
        code = run(words)
        message = capfd.readouterr()
        return CompletedProcess(words, code, message.out, message.err)

    return call


@pytest.fixture
def done(faintfield: Command) -> Command:
    """Run one command that must end well."""

    def call(*arguments: object) -> CompletedProcess[str]:
        ended = faintfield(*arguments)
        assert ended.returncode == 0, ended.stderr
        return ended

    return call


def assert_refused(ended: CompletedProcess[str], failure: str, *words: str) -> None:
    """Assert that a command ended by this failure, with these words in its message."""
    assert ended.returncode == 1, ended.stderr
    assert f"faintfield: {failure}: " in ended.stderr
    assert all(word in ended.stderr for word in words), ended.stderr


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a new folder that `make` fills, once for all processes of a run; to be read only."""
    base = factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"
    shared.mkdir(exist_ok=True)
    folder, complete = shared / name, shared / f"{name}.complete"
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not complete.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            with in_one_thread():
                make(folder)
            complete.touch()
    return folder


@contextmanager
def drawing_nothing() -> Iterator[pytest.MonkeyPatch]:
    """Leave drawings empty, and pictures as they are: text and compression take most of the time of a page."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", save_empty)
        for module in (report_sets, viewer_data):
            patch.setattr(module, "smaller_uri", lambda content, quality=LOSSLESS: data_uri(content, ".png"))
        yield patch


def run_undrawn(*words: object) -> None:
    """Run one command that must end well, with empty drawings."""
    with drawing_nothing():
        assert run([str(word) for word in words]) == 0


@pytest.fixture(autouse=True)
def undrawn() -> Iterator[pytest.MonkeyPatch]:
    """Pages with empty drawings; a test of drawings calls `undo`."""
    with drawing_nothing() as patch:
        yield patch


@pytest.fixture(scope="session")
def simulated_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small dark set with its truth, to be read only."""
    folder = made_once(tmp_path_factory, "simulated", lambda folder: run_undrawn("simulate", folder / "scene", *SMALL))
    return folder / "scene"


@pytest.fixture(scope="session")
def bright_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of more views and light than the small one, to be read only."""
    words = (*LARGER, "--snr", 2)
    return made_once(tmp_path_factory, "bright", lambda folder: run_undrawn("simulate", folder / "set", *words)) / "set"


@pytest.fixture(scope="session")
def dark_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of more views than the small one, as dark as that, to be read only."""
    return made_once(tmp_path_factory, "dark", lambda folder: run_undrawn("simulate", folder / "set", *LARGER)) / "set"


@pytest.fixture(scope="session")
def colour_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small set of a Bayer camera, to be read only."""
    words = ("--size-px", 64, 48, "--rows", 3, "--columns", 3, "--colour", "bayer", "--snr", 20)
    return made_once(tmp_path_factory, "colour", lambda folder: run_undrawn("simulate", folder / "set", *words)) / "set"


@pytest.fixture(scope="session")
def sweep(simulated_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of five planes, to be read only."""
    words = ("reconstruct", simulated_scene, "--sweep-mm", "500:700:5", "--method", "backprojection", "--out")
    return made_once(tmp_path_factory, "sweep-for-export", lambda folder: run_undrawn(*words, folder / "out")) / "out"


@pytest.fixture(scope="session")
def recorded_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A captured session without results, bright enough for its views to agree; to be read only."""
    text = rig_toml(camera="unlit_photons_per_s = 20000.0")
    return made_once(tmp_path_factory, "recorded", lambda folder: captured(folder, text)) / "session"


@pytest.fixture(scope="session")
def calibrated_session(recorded_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The session with noise, geometry and the back-projection at 700 mm, to be read only."""

    def make(folder: Path) -> None:
        shutil.copytree(recorded_session, folder / "session")
        with drawing_nothing():
            steps = steps_run(folder / "session", Options(depth_mm=[700.0], method=["backprojection"]))
        assert steps == ["noise", "geometry", "reconstruct"]

    return made_once(tmp_path_factory, "calibrated", make) / "session"


@pytest.fixture
def session(calibrated_session: Path, tmp_path: Path) -> Path:
    """A copy of the calibrated session that a test may change."""
    return Path(shutil.copytree(calibrated_session, tmp_path / "session"))


@pytest.fixture
def scene(simulated_scene: Path, tmp_path: Path) -> Path:
    """A copy of the small dark set that a test may change."""
    return Path(shutil.copytree(simulated_scene, tmp_path / "scene"))


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Searches:
    """Replace what is slow: the search for depths, σ, refinement and pictures; return what the search is given."""
    given: Searches = []

    def search(views: Any, inverse_depths: NDArray[np.float64], shared_sigma: float) -> SurfaceEstimate:
        given.append((views, inverse_depths))
        return found_at_once(views)

    preview = encoded(np.zeros((4, 4), np.uint8), ".png")
    monkeypatch.setattr(surface_depths, "estimate_surface", search)
    monkeypatch.setattr(surface_files, "map_picture", lambda *_: preview)
    monkeypatch.setattr(surface, "refined", lambda operator, images, plane: plane)
    monkeypatch.setattr(penalised, "standard_deviation", lambda local, *_: np.ones_like(local.plane))
    monkeypatch.setattr(surface_files, "render_parallax", lambda *_: [np.zeros((4, 4), np.uint8)] * 2)
    return given


@pytest.fixture(scope="session")
def written_surface(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A surface in mm made by hand, to be read only."""
    return made_once(tmp_path_factory, "surface", lambda folder: write_example(folder / "out")) / "out"


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
        views = [View(image, (0, column), (0, 0, 0, -10.0 * column, 0, 0)) for column, image in enumerate(images)]
        return write_set(tmp_path / name, views, noise=noise, camera=camera, exposure_s=exposure_s)

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
