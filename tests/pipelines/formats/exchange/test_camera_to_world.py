"""Poses by transforms.json and by tables: axes checked by hand on one point, round trips, and what is refused."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from faintfield.pipelines.errors import InputError
from faintfield.pipelines.formats.exchange.nerfstudio import read_transforms
from faintfield.pipelines.formats.exchange.pose_table import read_poses
from faintfield.pipelines.formats.sets.elemental_set import load_set
from tests.pipelines.conftest import Command, Edit, assert_refused

IMAGE = np.arange(192, dtype=np.uint16).reshape(12, 16)
POINT = np.array([0.4, -0.7, 5.0])


def images(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(folder / name, IMAGE)
    return folder


def turned_camera() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Right, down and forward of a camera in the world, as columns, and where it is: nothing symmetric about it."""
    forward = np.array([0.2, -0.3, 1.0])
    forward /= np.linalg.norm(forward)
    right = np.cross([0.1, 1.0, 0.05], forward)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(forward, right), forward]), np.array([0.5, -0.25, -1.5])


def seen_by_hand(axes: NDArray[np.float64], centre: NDArray[np.float64], fx: float, fy: float) -> tuple[float, float]:
    """Return how many px right of and below its principal point a camera sees the point, from its axes alone."""
    ray = POINT - centre
    right, down, forward = (float(ray @ axis) for axis in axes.T)
    return fx * right / forward, fy * down / forward


def seen_by_set(folder: Path, name: str, mm_per_unit: float = 1.0) -> list[float]:
    """Return where the lens and pose of a view put the point, in px from the first pixel's centre."""
    elemental_set = load_set(folder)
    index = [view.image for view in elemental_set.settings.view].index(name)
    rt = elemental_set.poses_rt_cam_ref[index]
    in_camera = Rotation.from_rotvec(rt[:3]).apply(mm_per_unit * POINT) + rt[3:]
    return list(map(float, elemental_set.lens.project(in_camera[np.newaxis])[0]))


def transforms(**changes: Any) -> dict[str, Any]:
    """One camera at the origin that looks along z with y down, and one that is turned, in axes of OpenGL."""
    axes, centre = turned_camera()
    right, down, forward = axes.T
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([right, -down, -forward, centre])
    straight = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": "images/a.tiff", "transform_matrix": straight.tolist()},
        {"file_path": "./images/b", "transform_matrix": matrix.tolist(), "sharpness": 3.5},
    ]
    lens = {"w": 16, "h": 12, "fl_x": 20.0, "fl_y": 22.0, "cx": 9.0, "cy": 5.5}
    return lens | {"camera_model": "OPENCV", "aabb_scale": 16, "frames": frames} | changes


def write_transforms(folder: Path, content: object) -> Path:
    path = images(folder, "images/a.tiff", "images/b.tiff") / "transforms.json"
    path.write_text(json.dumps(content))
    return path


def test_axes_of_transforms_json_are_true(tmp_path: Path, done: Command) -> None:
    path = write_transforms(tmp_path / "src", transforms())
    done("import", "nerfstudio", path, tmp_path / "set", "--mm-per-unit", 100, "--reference", "a.tiff")
    across, below = seen_by_hand(*turned_camera(), 20.0, 22.0)
    assert (across, below) != pytest.approx((below, across), abs=1)
    # Centres of pixels are whole numbers here, and halves there
    expected = [8.5 + across, 5.0 + below]
    assert seen_by_set(tmp_path / "set", "b.tiff", 100) == pytest.approx(expected, abs=1e-9)
    expected = [8.5 + 20 * 0.4 / 5, 5.0 + 22 * -0.7 / 5]
    assert seen_by_set(tmp_path / "set", "a.tiff", 100) == pytest.approx(expected, abs=1e-9)
    assert load_set(tmp_path / "set").settings.units.depth == "mm"
    done("import", "nerfstudio", path.parent, tmp_path / "relative")
    assert load_set(tmp_path / "relative").settings.units.depth == "relative"


def test_file_without_lens_states_its_angle(tmp_path: Path) -> None:
    content = transforms(camera_angle_x=0.8)
    for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_model"):
        del content[key]
    lens = read_transforms(write_transforms(tmp_path, content))[1].lens
    assert lens.size_px == (16, 12)
    assert (lens.cx_px, lens.cy_px) == (7.5, 5.5)
    # The left edge of the picture is half the angle off the axis, half a pixel beyond the first pixel's centre
    assert math.atan((lens.cx_px + 0.5) / lens.fx_px) == pytest.approx(0.4)
    assert lens.fy_px == lens.fx_px


def test_lens_of_frame_precedes_lens_of_file(tmp_path: Path) -> None:
    content = transforms(k1=-0.1, k2=0.02, p1=0.003, p2=-0.004, k3=0.005)
    content["frames"][1] |= {"cx": 7.25, "k1": -0.2}
    first, second = (image.lens for image in read_transforms(write_transforms(tmp_path, content)))
    assert (first.cx_px, second.cx_px, first.cy_px, second.cy_px) == (8.5, 6.75, 5.0, 5.0)
    assert first.distortion == (-0.1, 0.02, 0.003, -0.004, 0.005)
    assert second.distortion == (-0.2, 0.02, 0.003, -0.004, 0.005)


@pytest.mark.parametrize("disparity_px", [0.0, 2.5])
def test_exported_transforms_come_back(
    disparity_px: float, edit: Edit, tmp_path: Path, done: Command, faintfield: Command
) -> None:
    content = transforms(k1=-0.05, p2=0.001)
    content["frames"][1]["cx"] = 9.0 + disparity_px
    path = write_transforms(tmp_path / "src", content)
    done("import", "nerfstudio", path, tmp_path / "set", "--mm-per-unit", 10)
    done("export", "nerfstudio", tmp_path / "set", tmp_path / "out")
    words = ("--images", tmp_path / "set", "--mm-per-unit", 1)
    done("import", "nerfstudio", tmp_path / "out", tmp_path / "back", *words)
    first, back = load_set(tmp_path / "set"), load_set(tmp_path / "back")
    np.testing.assert_allclose(back.poses_rt_cam_ref, first.poses_rt_cam_ref, atol=1e-9)
    np.testing.assert_allclose(back.principal_points_px, first.principal_points_px, atol=1e-12)
    assert back.lens.fy_px == first.lens.fy_px
    assert back.lens.distortion[:4] == (-0.05, 0.0, 0.0, 0.001)
    written = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert ("fl_x" in written) == (disparity_px == 0.0)
    assert all(frame["transform_matrix"][3] == [0, 0, 0, 1] for frame in written["frames"])
    edit(tmp_path / "set", lambda settings: settings["camera"].update(distortion=[0.0] * 5 + [0.1]))
    ended = faintfield("export", "nerfstudio", tmp_path / "set", tmp_path / "none")
    assert_refused(ended, "BadValue", "calibrate with --lens opencv5, or export COLMAP")
    assert not (tmp_path / "none").exists()


def changed_frame(**changes: Any) -> dict[str, Any]:
    content = transforms()
    content["frames"][1] |= changes
    return content


@pytest.mark.parametrize(
    ("content", "failure", "words"),
    [
        (transforms(camera_model="OPENCV_FISHEYE"), "BadValue", "no counterpart here (OPENCV_FISHEYE); undistort"),
        (transforms(fl_x=None), "BadValue", "states neither fl_x nor camera_angle_x; export it again"),
        (transforms(w=17), "WrongSize", "is 16 x 12 px, its lens 17 x 12 px"),
        (changed_frame(transform_matrix=np.diag([1, 1, 2, 1]).tolist()), "BadValue", "frames[1] (./images/b): its rot"),
        (changed_frame(transform_matrix=np.diag([-1, 1, 1, 1]).tolist()), "BadValue", "its rotation mirrors the world"),
        (changed_frame(transform_matrix=np.diag([1, 1e308, 1, 1]).tolist()), "BadValue", "not finite, or has columns"),
        (changed_frame(file_path="../../etc/passwd"), "BadValue", "leaves the folder"),
        (changed_frame(file_path="images/link"), "BadValue", "leaves the folder"),
        (transforms(fl_x=math.nan), "BadValue", "export it again"),
    ],
)
def test_bad_transforms_json_is_refused(
    content: object, failure: str, words: str, tmp_path: Path, faintfield: Command
) -> None:
    path = write_transforms(tmp_path / "src", content)
    (path.parent / "images" / "link.tiff").symlink_to(images(tmp_path / "else", "x.tiff") / "x.tiff")
    assert_refused(faintfield("import", "nerfstudio", path, tmp_path / "set"), failure, words)
    assert not (tmp_path / "set").exists()


class TestPoseTables:
    """CSV: the header decides."""

    def table(self, folder: Path, text: str) -> Path:
        path = images(folder, "a.tiff", "b.tiff") / "poses.csv"
        path.write_text(text)
        return path

    def test_axes_of_a_table_are_true(self, tmp_path: Path, done: Command) -> None:
        axes, (x, y, z) = turned_camera()
        qx, qy, qz, qw = Rotation.from_matrix(axes).as_quat()
        rows: list[list[Any]] = [
            ["qw", "z", "Name", "x", "y", "qz", "qy", "qx"],
            [1, 0, "a.tiff", 0, 0, 0, 0, 0],
            [qw, z, "b", x, y, qz, qy, qx],
        ]
        path = self.table(tmp_path, "\n".join("\t".join(map(str, row)) for row in rows) + "\n")
        lens = ("--fx-px", 20, "--fy-px", 22, "--cx-px", 8.5, "--cy-px", 5, "--reference", "a.tiff")
        done("import", "poses", path, tmp_path / "set", *lens)
        across, below = seen_by_hand(axes, np.array([x, y, z]), 20.0, 22.0)
        assert seen_by_set(tmp_path / "set", "b.tiff") == pytest.approx([8.5 + across, 5 + below], abs=1e-9)
        assert load_set(tmp_path / "set").settings.units.depth == "relative"

    @pytest.mark.parametrize(
        ("header", "words", "unit", "distance"),
        [
            ("name,x_mm,y_mm,z_mm", (), "mm", 3.0),
            ("file, X_m, Y_m, Z_m", (), "mm", 3000.0),
            ("image,x,y,z", ("--mm-per-unit", 10), "mm", 30.0),
            ("name,x,y,z", (), "relative", 3.0),
        ],
    )
    def test_header_states_unit(
        self, header: str, words: tuple[object, ...], unit: str, distance: float, tmp_path: Path, done: Command
    ) -> None:
        path = self.table(tmp_path / "src", f"\ufeff# by hand\n{header}\nviews/a,0,0,0\nb.tiff,3,0,0\n")
        folder = images(tmp_path / "else", "views/a.tiff", "b.tiff")
        lens = ("--fx-px", 20, "--distortion", -0.1, "--distortion", 0.01)
        options = ("--images", folder, "--reference", "a.tiff", *lens)
        done("import", "poses", path, tmp_path / "set", *options, *words)
        elemental_set = load_set(tmp_path / "set")
        assert elemental_set.settings.units.depth == unit
        # A camera further right sees the reference frame shifted left
        expected = np.array([[0.0] * 6, [0.0, 0.0, 0.0, -distance, 0.0, 0.0]])
        np.testing.assert_allclose(elemental_set.poses_rt_cam_ref, expected, atol=1e-12)
        camera = elemental_set.lens
        assert (camera.cx_px, camera.cy_px, camera.distortion) == (7.5, 5.5, (-0.1, 0.01))

    def test_bad_table_is_refused(self, tmp_path: Path, faintfield: Command) -> None:
        for rows, words in (
            ("a.tiff,0,0\n", "row 1: has 3 columns, the first line 4; correct it"),
            ("a.tiff,0,nan,0\n", "row 1: y = 'nan' is no finite number"),
            ("a.tiff,0,1e99,0\n", "is not finite, or beyond 10 rad or 1e+09 mm"),
            ("a.tiff,0,0,0\na,1,0,0\n", "row 2: a.tiff has a pose already"),
            ("a.tiff,0,0,0\n../x.tiff,1,0,0\n", "row 2: name = '../x.tiff' leaves the folder"),
            ('a".tiff,0,0,"\n', "is no table that can be read"),
        ):
            path = self.table(tmp_path, f"name,x,y,z\n{rows}")
            assert_refused(faintfield("import", "poses", path, tmp_path / "set", "--fx-px", 20), "BadValue", words)
            assert not (tmp_path / "set").exists()

    @settings(max_examples=30)
    @given(place=st.tuples(*[st.floats()] * 3), junk=st.just("") | st.text(',;"\t\n#0.-e', max_size=9))
    def test_any_row_is_a_pose_or_refused(
        self, place: tuple[float, ...], junk: str, tmp_path_factory: pytest.TempPathFactory
    ) -> None:
        path = self.table(tmp_path_factory.mktemp("table"), f"name,x,y,z\nb,{','.join(map(repr, place))}{junk}")
        try:
            (pose,) = read_poses(path, path.parent)[0].values()
        except InputError:
            assert junk.strip() or not max(map(abs, place)) < 1e9
        else:
            assert np.isfinite(pose).all()
