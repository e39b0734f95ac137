"""Views that were taken after a homing of the stage, at the poses of a geometry.json."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from faintfield.pipelines.commands.simulation import simulate
from faintfield.pipelines.formats.files import sha256, write_json
from faintfield.pipelines.formats.results.geometry import (
    CameraPoses,
    HomingRecord,
    LensRecord,
    NodeRecord,
    PosesOfSession,
)
from faintfield.pipelines.formats.sets import session_set
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.formats.sets.session_set import with_measured_geometry
from faintfield.pipelines.simulation.options import SyntheticOptions
from faintfield.rig.session.homings import HomingGroups
from tests.calib.geometry.simulated import centres_mm

SIGMA_MM = (0.01, 0.01, 0.01)
CHAIN = [HomingRecord(0, 1, (0.1, -0.02, 0.0), SIGMA_MM), HomingRecord(1, 2, (0.0, 0.05, 0.3), SIGMA_MM)]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> ElementalSet:
    out = tmp_path_factory.mktemp("scene") / "set"
    simulate(
        out, options=SyntheticOptions(rows=3, columns=3, pitch_mm=100.0, poses="nominal", size_px=(64, 48), seed=3)
    )
    return load_set(out)


def geometry(homings: list[HomingRecord]) -> CameraPoses:
    rng = np.random.default_rng(1)
    nodes = []
    for row, column in np.ndindex(3, 3):
        a, b, c, x, y, z = rng.normal(0, [0.05] * 3 + [0.3] * 3).tolist()
        nodes.append(NodeRecord((row, column), (a, b, c, x - 100 * column, y - 100 * row, z), 0.1, 1e-4))
    lens = LensRecord("pinhole", 80.0, 80.0, 31.5, 23.5, ())
    return CameraPoses(lens=lens, size_px=(64, 48), reference_node=(1, 1), nodes=nodes, homings=homings)


def at_homings(scene: ElementalSet, homings: list[int]) -> ElementalSet:
    views = [
        msgspec.structs.replace(view, homing=homing) for view, homing in zip(scene.settings.view, homings, strict=True)
    ]
    return replace(scene, settings=msgspec.structs.replace(scene.settings, view=views))


def test_cameras_are_shifted_along_chain_of_homings(scene: ElementalSet, tmp_path: Path) -> None:
    """Shifts add up along the chain from homing 0 to 2, and count negative backwards."""
    known = geometry(CHAIN)
    write_json(tmp_path / "geometry.json", known)
    homings = [0, 1, 2, 0, 2, 1, 2, 1, 0]  # the reference is view 4
    views = with_measured_geometry(at_homings(scene, homings), tmp_path).settings.view
    unmoved = centres_mm(np.array([node.rt_cam_ref for node in known.nodes]))
    moved = centres_mm(np.array([view.rt_cam_ref for view in views])) - unmoved
    wanted = {0: (-0.1, -0.03, -0.3), 1: (0.0, -0.05, -0.3), 2: (0.0, 0.0, 0.0)}
    np.testing.assert_allclose(moved, [wanted[homing] for homing in homings], atol=1e-9)


def test_unknown_shift_is_warned_of(scene: ElementalSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_json(tmp_path / "geometry.json", geometry(CHAIN[:1]))
    elemental_set = with_measured_geometry(at_homings(scene, [0] * 6 + [5] * 3), tmp_path)
    assert "3 of 9 views (view_r2_c0.tiff is the first) may be off" in capsys.readouterr().err
    assert elemental_set.settings.view[8].rt_cam_ref == geometry([]).nodes[8].rt_cam_ref
    with_measured_geometry(at_homings(scene, [7] * 9), tmp_path)
    assert not capsys.readouterr().err, "one homing shifts all views alike"


class TakenFrame(NamedTuple):
    intent: int


@pytest.mark.parametrize("own", [True, False])
def test_sessions_have_homings_of_their_own(own: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "plan.json").write_text("{}")
    known = geometry(CHAIN)
    inputs = {"plan.json": sha256(tmp_path / "plan.json") if own else "0" * 64}
    record = PosesOfSession(**msgspec.structs.asdict(known), inputs=inputs)
    write_json(tmp_path / "geometry.json", record)
    frames = [(None, TakenFrame(intent), tmp_path / "frames" / f"{intent}.tiff") for intent in range(3)]
    monkeypatch.setattr(session_set, "taken_frames", lambda folder: frames)
    monkeypatch.setattr(session_set, "read_homing_groups", lambda folder: HomingGroups({0: 1, 1: 1, 2: 2}, None, 1))
    groups = session_set._homings_apart(tmp_path, tmp_path / "geometry.json")  # noqa: SLF001 - no public way without frames
    shifts = {homing: record.homing_shift_mm(groups["frames/0.tiff"], homing) for homing in groups.values()}
    assert len(shifts) == 2
    assert shifts[groups["frames/2.tiff"]] == (CHAIN[1].shift_mm if own else None)
