"""Planes given by a pose, on a tilted target whose views are computed by rays and points, without any homography."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from faintfield.pipelines.errors import BadValue, UnknownKey
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.plane_poses import read_plane_poses
from tests.pipelines.by_hand import View, write_set
from tests.pipelines.conftest import Command
from tests.pipelines.forms import read_record

WIDTH, HEIGHT, FOCAL_PX = 120, 90, 150.0
POINT_MM = np.array([10.0, -5.0, 600.0])
NORMAL = np.array([0.2, -0.7, 1.0])
UNIT = NORMAL / np.linalg.norm(NORMAL)


def _light_e(points_mm: NDArray[np.floating]) -> NDArray[np.floating]:
    """Waves over the target, by the places of its points in the reference frame; none as short as two pixels."""
    x, y, z = np.moveaxis(points_mm, -1, 0)
    waves = np.cos(0.22 * x + 0.05 * z) + np.cos(0.2 * y + 0.08 * z + 0.05 * x)
    return np.asarray(400 + 150 * waves)


def _picture(rt_cam_ref: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the picture of the target by a camera: each pixel's ray meets n · (p − p₀) = 0."""
    rotation = np.asarray(cv2.Rodrigues(rt_cam_ref[:3])[0])
    centre = -rotation.T @ rt_cam_ref[3:]
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([columns - (WIDTH - 1) / 2, rows - (HEIGHT - 1) / 2, np.full(columns.shape, FOCAL_PX)], axis=-1)
    rays = rays @ rotation
    length = (UNIT @ (POINT_MM - centre)) / (rays @ UNIT)
    return _light_e(centre + rays * length[..., np.newaxis])


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of 3 x 3 views of the tilted target, with little noise of quantisation and none other."""
    generator, views = np.random.default_rng(8), []
    for row, column in np.ndindex(3, 3):
        rt = np.array([0, 0, 0, 60.0 * (1 - column), 60.0 * (1 - row), 0])
        rt[:3] = 0 if (row, column) == (1, 1) else generator.normal(0, 5e-3, 3)
        views.append(View(np.round(100 + 20 * _picture(rt)).astype(np.uint16), (row, column), rt))
    noise = {"offset_dn": 100.0, "gain_dn_per_e": 20.0, "read_noise_e": 1.0}
    lens = {"fx_px": FOCAL_PX, "fy_px": FOCAL_PX}
    return write_set(tmp_path_factory.mktemp("tilted"), views, noise=noise, camera=lens, reference_view=4)


def _poses(path: Path, *planes: dict[str, Any], **others: Any) -> Path:
    path.write_text(tomli_w.dumps({"format": 1, "plane": list(planes), **others}))
    return path


def _points_mm(record: dict[str, Any]) -> NDArray[np.floating]:
    """Return where the samples of a plane are in the reference frame, (row, column, 3)."""
    rotation = np.asarray(cv2.Rodrigues(np.array(record["rt_ref_plane"][:3]))[0])
    rows, columns = np.indices(record["shape"])
    x, y = (record["origin_mm"][axis] + record["pitch_mm"] * index for axis, index in enumerate((columns, rows)))
    return np.asarray(np.stack([x, y, np.zeros_like(x)], axis=-1) @ rotation.T + record["rt_ref_plane"][3:])


def test_tilted_target_is_sharp_on_its_own_plane(target: Path, tmp_path: Path, done: Command) -> None:
    through_axis = (POINT_MM @ NORMAL / NORMAL[2]).item()
    poses = _poses(
        tmp_path / "poses.toml",
        {"name": "target", "point_mm": POINT_MM.tolist(), "normal": NORMAL.tolist()},
        {"name": "other-way", "point_mm": POINT_MM.tolist(), "normal": [0.2, 0.7, 1.0], "size_mm": [300.0, 200.0]},
    )
    out = tmp_path / "out"
    options = ("--depth-mm", through_axis, "--method", "backprojection")
    done("reconstruct", target, "--out", out, "--plane-pose", poses, *options)
    across, tilted, other = read_record(out)["planes"]
    assert (tilted["name"], tilted["file"], other["file"]) == ("target", "plane_target.tiff", "plane_other-way.tiff")
    assert tilted["depth_mm"] == pytest.approx(through_axis)
    np.testing.assert_allclose(cv2.Rodrigues(np.array(tilted["rt_ref_plane"][:3]))[0][:, 2], UNIT, atol=1e-9)

    plane, truth = read_frame(out / tilted["file"]).pixels_dn, _light_e(_points_mm(tilted))
    points = _points_mm(tilted)
    inside = np.all(np.abs(points[..., :2] / points[..., 2:] * FOCAL_PX) < [WIDTH / 2 - 30, HEIGHT / 2 - 25], axis=-1)
    assert inside.sum() > 1000
    # Interpolation takes a little of waves of some ten samples
    assert np.sqrt(np.mean((plane - truth)[inside] ** 2)) < 0.15 * np.std(truth[inside])

    # The plane across the axis overlays the reference view: the views disagree where the target is off it
    frontal, reference = read_frame(out / across["file"]).pixels_dn, _picture(np.zeros(6))
    off = np.abs(frontal - reference)[2:12, 40:80].mean() / np.abs(frontal - reference)[42:48, 56:64].mean()
    assert off > 3
    assert np.std(read_frame(out / other["file"]).pixels_dn[:12, 20:-20]) < 0.7 * np.std(truth)


def test_tilted_planes_are_shown_and_kept(target: Path, tmp_path: Path, done: Command) -> None:
    poses = _poses(tmp_path / "poses.toml", {"name": "table", "rt_ref_plane": [0.3, 0, 0, 0, 0, 600.0]})
    options = ("--plane-pose", poses, "--sweep-mm", "500:700:3", "--method", "backprojection")
    done("reconstruct", target, "--out", tmp_path / "out", *options)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "table, 600.0 mm on the axis" in page
    assert "What all views show, 600 mm" in page
    assert "4 of 4 planes are there" in done("reconstruct", target, "--out", tmp_path / "out", *options).stderr
    assert read_record(tmp_path / "out")["focus"]["depth_mm"] == [500, 600, 700]
    _poses(tmp_path / "poses.toml", {"name": "table", "rt_ref_plane": [0.31, 0, 0, 0, 0, 600.0]})
    assert "3 of 4 planes are there" in done("reconstruct", target, "--out", tmp_path / "out", *options).stderr


def test_pose_across_the_axis_equals_depth(target: Path, tmp_path: Path, done: Command) -> None:
    poses = _poses(tmp_path / "poses.toml", {"name": "same", "point_mm": [0, 0, 600.0], "normal": [0, 0, -1.0]})
    options = ("--plane-pose", poses, "--depth-mm", 600, "--prior", "tv", "--passes", 3, "--uncertainty")
    done("reconstruct", target, "--out", tmp_path / "out", *options)
    report = (tmp_path / "out" / "report.html").read_text()
    assert all(f'"Standard deviation: PMLEM, {words}' in report for words in ("600 mm", "same, 600.0 mm on the axis"))
    by_depth, by_pose = (read_frame(tmp_path / "out" / f"plane_{name}.tiff").pixels_dn for name in ("00600.0", "same"))
    np.testing.assert_allclose(by_pose, by_depth, rtol=1e-5)


numbers = st.floats(-1, 1)


@given(st.tuples(numbers, numbers, st.floats(0.2, 1)), st.tuples(numbers, numbers), st.floats(100, 1000))
def test_any_normal_becomes_pose_whose_plane_holds_point(
    normal: tuple[float, float, float], beside: tuple[float, float], depth_mm: float
) -> None:
    point = np.array([0.3 * depth_mm * beside[0], 0.3 * depth_mm * beside[1], depth_mm])
    with TemporaryDirectory() as folder:
        path = _poses(Path(folder) / "p.toml", {"name": "p", "point_mm": point.tolist(), "normal": list(normal)})
        (plane,) = read_plane_poses([path])
    assert abs(abs(plane.normal @ normal) / np.linalg.norm(normal) - 1) < 1e-9
    assert plane.normal @ point >= 0
    np.testing.assert_allclose(plane.on_plane(point[np.newaxis] / point[2]), [[0, 0]], atol=1e-6 * depth_mm)


@pytest.mark.parametrize(
    ("plane", "failure", "message"),
    [
        ({"name": "00600.0", "rt_ref_plane": [0.0] * 5 + [600.0]}, BadValue, "is no name for files"),
        ({"name": "a", "point_mm": [0, 0, 1.0]}, BadValue, "give either rt_ref_plane, or point_mm and normal"),
        ({"name": "a", "point_mm": [0, 0, 1.0], "normal": [0, 0, 0]}, BadValue, "has no direction"),
        ({"name": "a", "rt_ref_plane": [0.0] * 6, "size_mm": [0, 1]}, BadValue, "is no size"),
        ({"name": "a", "rt": [0.0] * 6}, UnknownKey, "'plane[0].rt' is not a key"),
    ],
)
def test_what_is_no_plane_is_refused(
    plane: dict[str, Any], failure: type[Exception], message: str, tmp_path: Path
) -> None:
    with pytest.raises(failure) as refused:
        read_plane_poses([_poses(tmp_path / "p.toml", plane)])
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ({"rt_ref_plane": [0, 1.5, 0, 0, 0, 600.0]}, "does not meet it in front"),
        ({"rt_ref_plane": [0, 1.12, 0, 0, 0, 600.0]}, "samples, and at most"),
        ({"point_mm": [0, 0, -600.0], "normal": [0, 0, 1.0], "size_mm": [100.0, 80.0]}, "lies behind the camera"),
    ],
)
def test_plane_outside_view_is_refused(
    pose: dict[str, Any], message: str, target: Path, tmp_path: Path, faintfield: Command
) -> None:
    poses = _poses(tmp_path / "poses.toml", {"name": "a", **pose})
    ended = faintfield("reconstruct", target, "--out", tmp_path / "out", "--plane-pose", poses)
    assert ended.returncode == 1
    assert message in ended.stderr
