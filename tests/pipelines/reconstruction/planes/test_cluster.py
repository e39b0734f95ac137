"""A sweep on dask.distributed: the same planes, and what is lost when a worker dies or a task fails."""

import os
import shutil
import signal
import sys
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.formats.files import UNFINISHED
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.plane_poses import Place
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.reconstruction.planes.sweep import PlaneTask
from faintfield.pipelines.reconstruction.planes.workers import make_runner
from faintfield.pipelines.reconstruction.request import Request
from faintfield.pipelines.reconstruction.run import reconstruct_set
from tests.pipelines.conftest import Command, Edit, assert_refused
from tests.pipelines.forms import plane_files

distributed = pytest.importorskip("distributed")

DEPTHS_MM = [500.0, 550.0, 600.0, 650.0]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A scheduler in this process, and two workers of one thread each."""
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0", "memory_limit": 0}
    with distributed.LocalCluster(**options, env={"NUMBA_NUM_THREADS": "1"}, silence_logs=50) as started:
        yield started


def _kill_one_that_works(cluster: Any) -> None:
    """Kill a worker that is at a task, as nothing can be caught."""
    with distributed.Client(cluster, set_as_default=False) as client:
        processes = client.run(os.getpid)
    address = next(state.address for state in cluster.scheduler.workers.values() if state.processing)
    os.kill(processes[address], signal.SIGKILL)


@pytest.mark.deep
def test_worker_killed_in_sweep_costs_one_plane(cluster: Any, simulated_scene: Path, tmp_path: Path) -> None:
    elemental_set = load_set(simulated_scene)
    request = Request(DEPTHS_MM, ["pmlem"], SolverOptions(penalty_weight=1.0, passes=3, prior="tv"), with_focus=True)
    reconstruct_set(elemental_set, tmp_path / "local", request)
    runner = make_runner(None, cluster.scheduler_address)
    done: list[Place] = []

    def killing(
        elemental_set: ElementalSet, out: Path, tasks: Sequence[PlaneTask]
    ) -> Generator[tuple[PlaneTask, list[str]]]:
        for task, messages in runner(elemental_set, out, tasks):
            done.extend(task.grids)
            if len(done) == 1:
                _kill_one_that_works(cluster)
            yield task, messages

    before = len(cluster.scheduler.transition_log)
    reconstruct_set(elemental_set, tmp_path / "spread", request, killing)
    changes = [(entry[1], entry[2]) for entry in list(cluster.scheduler.transition_log)[before:]]
    assert ("processing", "released") in changes  # what it was at is taken from it
    # Nothing that is finished is done again, but for a plane nobody had been told of
    assert changes.count(("processing", "memory")) <= len(DEPTHS_MM) + 1
    assert {*done} == {*DEPTHS_MM}
    assert len(done) == len(DEPTHS_MM)
    assert plane_files(tmp_path / "spread") == plane_files(tmp_path / "local")
    assert not list((tmp_path / "spread").glob(f".*{UNFINISHED}"))


@pytest.mark.deep
def test_task_that_fails_is_failure_of_command(cluster: Any, scene: Path, tmp_path: Path, faintfield: Command) -> None:
    words = ("--out", tmp_path / "out", "--depth-mm", 500, "--method", "pmlem-osl", "--penalty-weight", 50)
    ended = faintfield("reconstruct", scene, *words, "--scheduler", cluster.scheduler_address)
    assert_refused(ended, "NotConverged", "penalty weight 50 makes most denominators")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "options", [("--prior", "tv", "--occlusion"), pytest.param(("--prior", "patches"), marks=pytest.mark.deep)]
)
def test_workers_give_same_colour_planes_in_relative_light(
    options: tuple[str, ...], colour_set: Path, tmp_path: Path, edit: Edit, done: Command
) -> None:
    folder = Path(shutil.copytree(colour_set, tmp_path / "set"))
    edit(folder, lambda settings: settings["noise"].update(saturation_dn=150.0))
    edit(folder, lambda settings: settings.update(units={"light": "relative"}))  # to white: gain and saturation count
    assert max(read_frame(path).pixels_dn.max() for path in load_set(folder).image_paths) >= 150
    quick = ("--depth-mm", 500, "--depth-mm", 700, "--passes", 1, "--penalty-weight", 1)
    words = ("reconstruct", folder, *quick, *options)
    done(*words, "--out", tmp_path / "local")
    done(*words, "--out", tmp_path / "spread", "--workers", 1)
    assert plane_files(tmp_path / "spread") == plane_files(tmp_path / "local")


def test_scheduler_needs_dask_and_an_answer(
    simulated_scene: Path, tmp_path: Path, faintfield: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    import dask

    words = ("reconstruct", simulated_scene, "--out", tmp_path / "out", "--depth-mm", 500, "--method", "backprojection")
    with dask.config.set({"distributed.comm.timeouts.connect": "0.2s"}):
        ended = faintfield(*words, "--scheduler", "tcp://127.0.0.1:1")
    assert_refused(ended, "ClusterFailed", "no scheduler answers at tcp://127.0.0.1:1")
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.setitem(sys.modules, "dask", None)
    ended = faintfield(*words, "--scheduler", "tcp://127.0.0.1:1")
    assert_refused(ended, "MissingPackage", "pip install 'faintfield[cluster]'")
    assert faintfield(*words, "--workers", 2).returncode == 0
