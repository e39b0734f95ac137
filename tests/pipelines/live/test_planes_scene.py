"""Scenes of live planes from a session that is not complete, and the planes computed from them."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.geometry import CameraPoses, LensRecord, NodeRecord
from faintfield.pipelines.formats.sets.session_set import load_session
from faintfield.pipelines.live.plane_accumulator import Picture, PlaneAccumulator
from faintfield.pipelines.live.planes_client import LiveFrame, LiveOrder, PictureKind
from faintfield.pipelines.live.planes_process import stretch
from faintfield.pipelines.live.planes_scene import LiveScene, bins_of, live_scene
from faintfield.pipelines.live.view_sums import RoundSums
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.pipelines.reconstruction.planes.penalised import Objective, certified
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.initialization import back_projection
from faintfield.recon.solver.penalty_weight import universal_penalty_weight
from faintfield.rig.cameras.settings import FolderSettings
from faintfield.rig.plan import Until, nominal_poses_rt_cam_ref
from faintfield.rig.session.session import read_plan, taken_frames
from tests.pipelines.by_hand import write_fitted_noise
from tests.pipelines.sessions import captured, rig_toml

_DEPTH_MM = 500.0
_SIZE_PX = (320, 240)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A captured dark scene of two frames per node, with noise and geometry as if measured."""
    text = rig_toml(["dark_scene"]).replace("frames_per_node = 1", "frames_per_node = 2")
    folder = captured(tmp_path_factory.mktemp("live"), text.replace("pitch_mm = 100.0", "pitch_mm = 30.0"))
    write_fitted_noise(folder, {"read_noise_e": 12**0.5, "dark_current_e_per_s": 0.5})
    write_geometry(folder / "geometry.json", 3)
    return folder


def write_geometry(path: Path, rows: int) -> None:
    poses = nominal_poses_rt_cam_ref(rows, 3, 30.0) + 0.001 * np.arange(6)
    poses[rows // 2 * 3 + 1] = 0
    nodes = [NodeRecord(divmod(view, 3), tuple(pose), 0.1, 0.1) for view, pose in enumerate(poses.tolist())]
    lens = LensRecord("opencv", 400.0, 400.0, 160.0, 119.0, (-0.08, 0.02))
    content = CameraPoses(lens=lens, size_px=_SIZE_PX, reference_node=(rows // 2, 1), nodes=nodes)
    path.write_bytes(msgspec.json.encode(content))


def frames_of(session: Path) -> list[LiveFrame]:
    return [
        LiveFrame(taken.intent, taken.file, planned.stop.node, planned.exposure_s, planned.round)
        for planned, taken, _ in taken_frames(session)
    ]


def scene_of(session: Path, geometry: Path | None = None) -> LiveScene:
    order = LiveOrder(session, session / "nowhere" / "rig.toml", (_DEPTH_MM,), geometry=geometry)
    return live_scene(order, read_plan(session), read_frame(session / "frames" / frames_of(session)[0].file))


@pytest.mark.parametrize("bins", [1, 2])
def test_frames_in_turn_give_planes_of_the_session(session: Path, bins: int) -> None:
    elemental_set = load_session(session)
    [layout] = channel_layouts(elemental_set)
    images = load_channel(elemental_set, layout).binned(bins)
    grid = plane_grid(elemental_set, _DEPTH_MM).binned(bins)
    operator = OperatorFactory(elemental_set, layout, images, bins=bins).at(_DEPTH_MM, grid)

    planes = PlaneAccumulator(replace(scene_of(session), bins=bins), session / "frames", [_DEPTH_MM])
    frames = frames_of(session)
    void = frames[4]
    for frame in [frames[7], *frames[:7], *frames[8:]]:
        planes.add(frame)
    # A frame that becomes void and is taken again, of the same file
    planes.remove([void])
    assert planes.complete == 8
    planes.add(msgspec.structs.replace(void, intent=999))
    assert (planes.complete, len(planes.nodes), len(planes.frames)) == (9, 9, 18)

    found = planes.picture(0, "mean")
    assert found is not None
    plane, covered, nodes, _ = found
    expected = back_projection(operator, images) / bins**2
    assert nodes == 9
    assert covered.mean() > 0.9
    np.testing.assert_allclose(plane[covered], expected[covered], atol=2e-3 * np.abs(expected).max())

    assert planes.picture(0, "pmlem") is None
    rounds, interrupted = 0, bins == 2
    while not planes.is_refined(0):
        planes.refine(0, lambda: interrupted)
        assert planes.picture(0, "pmlem") is not None
        rounds += 1
    assert 1 < rounds < 15 if interrupted else rounds == 1
    objective = Objective.of(SceneProblem(operator, images), SolverOptions())
    weight = universal_penalty_weight(operator, objective.posed.images, objective.start)
    record, solved = certified(objective, objective.start, weight, objective.posed.dual())
    assert record.certificate is not None
    assert record.certificate.reached
    refined = planes.picture(0, "pmlem")
    assert refined is not None
    difference = np.linalg.norm(refined[0] - solved / bins**2) / np.linalg.norm(solved / bins**2)
    assert difference < 0.03  # each lies within 2 % and 1 % of the optimum


def test_incomplete_nodes_keep_only_their_sums(session: Path) -> None:
    """A process that lags behind takes the newest frames first, so that many nodes are incomplete."""
    scene, frame = replace(scene_of(session), rounds_s=((0.1,) * 40,)), frames_of(session)[0]
    planes = PlaneAccumulator(scene, session / "frames", [_DEPTH_MM])
    planes.add(frame)
    tracemalloc.start()
    try:
        for intent in range(1001, 1039):
            planes.add(msgspec.structs.replace(frame, intent=intent))
        kept_bytes, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert planes.complete == 0
    planes.add(msgspec.structs.replace(frame, intent=1039))
    assert planes.complete == 1
    assert kept_bytes < 4 * (4 * _SIZE_PX[0] * _SIZE_PX[1])


def in_rounds(session: Path) -> tuple[LiveScene, list[LiveFrame]]:
    """Return scene and frames of the session as if the two frames of a node were of two rounds."""
    frozen, frames = read_plan(session), frames_of(session)
    [step] = frozen.plan.steps
    rounds = msgspec.structs.replace(step, frames_per_node=1, until=Until(0.1, 2))
    frozen = msgspec.structs.replace(frozen, plan=msgspec.structs.replace(frozen.plan, steps=(rounds,)))
    order = LiveOrder(session, session / "nowhere" / "rig.toml", (_DEPTH_MM,))
    scene = live_scene(order, frozen, read_frame(session / "frames" / frames[0].file))
    return scene, [msgspec.structs.replace(frame, round=number) for number in (0, 1) for frame in frames[number::2]]


def planes_of(session: Path, scene: LiveScene, frames: list[LiveFrame]) -> PlaneAccumulator:
    planes = PlaneAccumulator(scene, session / "frames", [_DEPTH_MM])
    for frame in frames:
        planes.add(frame)
    return planes


def picture_of(planes: PlaneAccumulator, kind: PictureKind) -> Picture:
    if kind == "pmlem":
        planes.refine(0, lambda: False)
    picture = planes.picture(0, kind)
    assert picture is not None
    return picture


def test_rounds_of_same_frames_keep_mean(session: Path) -> None:
    scene, frames = in_rounds(session)
    assert scene.rounds_s == ((0.1,), (0.1,))
    first = frames[:9]
    again = [msgspec.structs.replace(frame, intent=100 + frame.intent, round=1) for frame in first[:4]]
    one = picture_of(planes_of(session, scene, first), "mean")
    planes = planes_of(session, scene, first + again)
    more = picture_of(planes, "mean")
    assert (one.rounds, more.rounds) == (1, 2)
    for frame in first[4:]:
        planes.add(msgspec.structs.replace(frame, intent=100 + frame.intent, round=1))
    whole = picture_of(planes, "mean")
    np.testing.assert_allclose(whole.plane, one.plane, atol=1e-4 * np.abs(one.plane).max())
    level_e = [float(np.median(picture.plane[one.covered])) for picture in (one, more)]
    assert level_e[1] == pytest.approx(level_e[0], rel=0.1)


def test_whole_rounds_refine_as_their_sum(session: Path) -> None:
    scene, frames = in_rounds(session)
    planes = planes_of(session, scene, frames[:4])
    assert (planes.complete, planes.rounds) == (4, 1)  # before the first round is whole
    for frame in frames[4:17]:
        planes.add(frame)
    first = picture_of(planes, "pmlem")
    assert (first.nodes, first.rounds, planes.is_refined(0)) == (9, 1, True)  # within the second
    planes.add(frames[17])
    assert not planes.is_refined(0)
    both = picture_of(planes, "pmlem")
    assert (both.nodes, both.rounds, planes.is_refined(0)) == (9, 2, True)
    summed = picture_of(planes_of(session, scene_of(session), frames_of(session)), "pmlem")
    # The sum is of twice the light; each lies within 2 % of the optimum
    assert np.linalg.norm(2 * both.plane - summed.plane) < 0.04 * np.linalg.norm(summed.plane)
    assert np.linalg.norm(2 * first.plane - summed.plane) > 0.05 * np.linalg.norm(summed.plane)


def test_late_and_void_frames_of_earlier_rounds(session: Path) -> None:
    scene, frames = in_rounds(session)
    in_turn = planes_of(session, scene, frames)
    lagging = planes_of(session, scene, [*frames[:2], *frames[:1:-1]])
    void = [frames[3], frames[12]]
    for planes, of_round in ((in_turn, 0), (lagging, 1)):
        assert (planes.complete, planes.rounds) == (9, 2)
        planes.remove(void[:1])
        planes.remove(void[1:])
        assert planes.complete == 8
        planes.add(msgspec.structs.replace(void[of_round], intent=900))
        assert planes.complete == 8
        planes.add(msgspec.structs.replace(void[1 - of_round], intent=901))
        assert (planes.complete, len(planes.frames)) == (9, 18)
    kinds: tuple[PictureKind, ...] = "mean", "pmlem"
    for kind in kinds:
        first, second = (picture_of(planes, kind).plane for planes in (in_turn, lagging))
        np.testing.assert_allclose(second, first, atol=2e-3 * first.max())


def test_void_rounds_begin_again_with_first_nodes(session: Path) -> None:
    """Lost steps make all frames void that were taken since the stage homed."""
    scene, frames = in_rounds(session)
    planes = planes_of(session, scene, frames)
    picture_of(planes, "pmlem")
    for first, second in zip(frames[:9], frames[9:], strict=True):
        planes.remove([first, second])
    assert (planes.complete, len(planes.frames), planes.picture(0, "mean")) == (0, 0, None)
    for frame in frames[:2]:
        planes.add(msgspec.structs.replace(frame, intent=100 + frame.intent))
    assert (planes.complete, planes.rounds, planes.is_refined(0)) == (2, 1, False)


def test_sums_are_equal_in_any_order() -> None:
    """Three rounds of three nodes, of one, two and one frames per view."""
    generator = np.random.default_rng(5)
    rounds = [(node, number) for number, frames in enumerate((1, 2, 1)) for node in range(3) for _ in range(frames)]
    images = [ElementalImages(generator.normal(3.0, 1.0, (1, 2, 4)).astype(np.float32)) for _ in rounds]
    expected = np.zeros((3, 2, 4))
    for (node, _), image in zip(rounds, images, strict=True):
        expected[node] += image.electrons[0]
    orders = [range(12), range(11, -1, -1), *(generator.permutation(12) for _ in range(20))]
    for order in orders:
        sums = RoundSums((2, 4), 3, (1, 2, 1))
        for index in order:
            view, number = rounds[index]
            sums.add(view, number, images[index])
        assert sums.rounds == 3
        views = list(sums.shared.views)
        assert sorted(views) == [0, 1, 2]
        np.testing.assert_allclose(sums.shared.images(0.0, 1.0).electrons, expected[views], atol=1e-5)


def test_measured_poses_precede_nominal_ones(session: Path, tmp_path: Path) -> None:
    measured = scene_of(session)
    assert measured.poses == f"measured, of {session / 'geometry.json'}"
    assert measured.elemental_set.poses_rt_cam_ref[0, 0] == 0.0
    assert measured.elemental_set.poses_rt_cam_ref[0, 1] == 0.001
    write_geometry(tmp_path / "geometry.json", 1)
    lacking = scene_of(session, geometry=tmp_path)
    assert lacking.poses.startswith("nominal, as the stage is told, because ")
    assert "has no pose for 6 of 9 views" in lacking.poses
    assert lacking.elemental_set.lens.fx_px == 400.0
    np.testing.assert_array_equal(lacking.elemental_set.poses_rt_cam_ref[:, :3], 0.0)
    np.testing.assert_allclose(lacking.elemental_set.poses_rt_cam_ref[0], [0, 0, 0, 30, 30, 0])


def test_missing_noise_gives_dn_but_lens_is_needed(session: Path, tmp_path: Path) -> None:
    frozen, frame = read_plan(session), read_frame(session / "frames" / frames_of(session)[0].file)
    rig = msgspec.structs.replace(frozen.rig, camera=FolderSettings("frames"))  # a camera that is not simulated
    frozen = msgspec.structs.replace(frozen, rig=rig)
    order = LiveOrder(tmp_path, tmp_path / "rig.toml", (_DEPTH_MM,))
    with pytest.raises(MissingFile, match=r"no lens is known, and live planes need one; run .* --geometry or --fx-px"):
        live_scene(order, frozen, frame)
    scene = live_scene(msgspec.structs.replace(order, fx_px=410.0), frozen, frame)
    assert (scene.knows_noise, scene.elemental_set.lens.fx_px) == (False, 410.0)
    planes = PlaneAccumulator(scene, session / "frames", [_DEPTH_MM])
    planes.add(frames_of(session)[8])
    found = planes.picture(0, "view")
    assert found is not None
    assert np.median(found[0][found[1]]) == pytest.approx(2 * 100.0, rel=0.1)  # of one of two frames of a view
    assert planes.is_refined(0)  # there is nothing that PMLEM could do


def test_bins_leave_about_million_pixels() -> None:
    sizes_px = [((1024, 1024), 1), ((640, 480), 2), ((6000, 4000), 1), ((6000, 4000), 2)]
    assert [bins_of(size_px, period_px) for size_px, period_px in sizes_px] == [1, 2, 5, 6]


def test_stretch_leaves_out_outliers_and_uncovered_samples() -> None:
    plane = np.linspace(0.0, 1.0, 1000).reshape(20, 50).astype(np.float32)
    plane[0, 0], plane[19] = 1e6, -1e6
    covered = np.ones(plane.shape, bool)
    covered[19] = False
    black, white = stretch(plane, covered)
    assert black == pytest.approx(0.005, abs=0.002)
    assert white == pytest.approx(0.95, abs=0.005)
    assert stretch(plane, np.zeros(plane.shape, bool)) == (0.0, 1.0)


def test_repeated_frames_add_up(session: Path) -> None:
    """Twice the frames: twice the electrons, the dark electrons and the read variance."""
    elemental_set = load_session(session)
    assert elemental_set.frames_per_view == 2
    assert elemental_set.settings.exposure_s == pytest.approx(0.2)
    (layout,) = channel_layouts(elemental_set)
    images = load_channel(elemental_set, layout)
    frames = [path for planned, _, path in taken_frames(session) if planned.stop.node == (0, 2)]
    assert len(frames) == 2
    by_hand = sum((read_frame(path).pixels_dn - 100.0) / 2.0 for path in frames)
    np.testing.assert_allclose(images.electrons[2], by_hand, atol=1e-3)
    np.testing.assert_allclose(images.read_variance_e2, 2 * (12 + 1 / 48), rtol=1e-5)
    np.testing.assert_allclose(images.background_e, 0.2 * 0.5, rtol=1e-5)
    # The variance of pixels without light is that of both parts
    unlit = images.electrons[2][:20, :40]
    assert np.var(unlit) == pytest.approx(2 * 12 + 0.1, rel=5 * np.sqrt(2 / unlit.size))
