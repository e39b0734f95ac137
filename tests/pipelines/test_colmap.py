"""Models that COLMAP's own library wrote: where they put points, and where we do."""

import importlib.util
import json
import struct
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from faintfield.pipelines.commands.exports.colmap import export_colmap
from faintfield.pipelines.commands.imports.colmap import import_colmap
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.exchange.colmap import ColmapImage, ColmapModel, read_model, write_model
from faintfield.pipelines.formats.exchange.imported_set import relative
from faintfield.pipelines.formats.sets.elemental_set import load_set

STORED = Path(__file__).parent / "colmap"


def seen_by(model: ColmapModel, points: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return where each image sees points of the world, by what was read."""
    seen = {}
    for image in model.images:
        rt = image.rt_cam_world
        seen[image.name] = model.lenses[image.camera].project(Rotation.from_rotvec(rt[:3]).apply(points) + rt[3:])
    return seen


def check_model(folder: Path) -> None:
    """What COLMAP's library sees of a model in text and in binary is what we do, half a pixel apart."""
    truth = json.loads((folder / "seen.json").read_text())
    for kind in ("text", "binary"):
        seen = seen_by(read_model(folder / kind), np.array(truth["points"]))
        assert list(seen) == list(truth["seen"])
        for name, pixels in seen.items():
            np.testing.assert_allclose(pixels + 0.5, truth["seen"][name], atol=1e-9, err_msg=f"{kind} {name}")


def test_models_that_colmap_wrote_see_what_colmap_sees() -> None:
    check_model(STORED)


@pytest.fixture
def writer() -> ModuleType:
    """The script that writes models by COLMAP's library, where that is installed."""
    pytest.importorskip("pycolmap", reason="pycolmap is not installed: only its stored models are read")
    spec = importlib.util.spec_from_file_location("colmap_by_pycolmap", Path(__file__).parent / "colmap_by_pycolmap.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_models_that_colmap_writes_now_see_what_colmap_sees(writer: ModuleType, tmp_path: Path) -> None:
    writer.write(tmp_path)
    check_model(tmp_path)


def test_cameras_without_counterpart_are_refused_by_name(writer: ModuleType, tmp_path: Path) -> None:
    made, _ = writer.model({"OPENCV_FISHEYE": [800.0, 805.0, 320.0, 240.0, 0.1, 0.0, 0.0, 0.0]})
    made.write_text(str(tmp_path))
    with pytest.raises(BadValue, match=r"cameras.txt: camera model OPENCV_FISHEYE has no counterpart here; let"):
        read_model(tmp_path)
    (tmp_path / "cameras.txt").unlink()
    made.write_binary(str(tmp_path))
    with pytest.raises(BadValue, match=r"cameras.bin: camera model 5 has no counterpart here; let"):
        read_model(tmp_path)


def test_colmap_opens_what_we_write(writer: ModuleType, tmp_path: Path) -> None:
    import pycolmap  # type: ignore[import-not-found]

    stored = read_model(STORED / "text")
    model = ColmapModel(stored.lenses, [replace(image, name=image.name.replace(" ", "_")) for image in stored.images])
    points = np.array(json.loads((STORED / "seen.json").read_text())["points"])
    for binary in (False, True):
        folder = tmp_path / str(binary)
        folder.mkdir()
        write_model(folder, model, binary=binary)
        opened, ours = pycolmap.Reconstruction(str(folder)), seen_by(model, points)
        assert len(opened.images) == len(model.images)
        for image in opened.images.values():
            pose, camera = image.cam_from_world(), opened.cameras[image.camera_id]
            theirs = [camera.img_from_cam(pose.rotation.matrix() @ point + pose.translation) for point in points]
            np.testing.assert_allclose(np.array(theirs) - 0.5, ours[image.name], atol=1e-9)


def test_a_text_model_takes_no_names_that_colmap_would_cut(tmp_path: Path) -> None:
    with pytest.raises(BadValue, match="has a space, where COLMAP ends a name in a text model; use --binary"):
        write_model(tmp_path, read_model(STORED / "binary"), binary=False)
    assert not list(tmp_path.iterdir())


def test_a_model_becomes_an_elemental_set(tmp_path: Path) -> None:
    """One camera of the stored model, its images in a folder below, its unit a metre."""
    model = read_model(STORED / "text")
    one = [image for image in model.images if image.camera in (4, 5)]
    lone = ColmapModel({4: model.lenses[4]}, [replace(image, camera=4) for image in one])
    (tmp_path / "model").mkdir()
    write_model(tmp_path / "model", lone, binary=True)
    for image in one:
        (tmp_path / image.name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / image.name), np.zeros((480, 640), np.uint16))
    import_colmap(
        tmp_path / "model", tmp_path / "set", images=tmp_path, mm_per_unit=1000, reference="radial r4.png", exposure_s=1
    )
    loaded = load_set(tmp_path / "set")
    assert (loaded.lens.fx_px, loaded.lens.cx_px, loaded.lens.cy_px) == (800.0, 322.0, 237.75)
    expected = relative(*(image.rt_cam_world * [1, 1, 1, 1000, 1000, 1000] for image in reversed(one)))
    np.testing.assert_allclose(loaded.poses_rt_cam_ref, [np.zeros(6), expected], atol=1e-9)
    export_colmap(tmp_path / "set", tmp_path / "back", binary=True)
    back = read_model(tmp_path / "back")
    np.testing.assert_allclose([image.rt_cam_world for image in back.images], [np.zeros(6), expected], atol=1e-9)


@pytest.mark.parametrize("points", [2**58, 2**62])
def test_a_file_that_promises_more_points_than_any_is_refused(points: int, tmp_path: Path) -> None:
    write_model(tmp_path, read_model(STORED / "binary"), binary=True)
    path = tmp_path / "images.bin"
    path.write_bytes(path.read_bytes()[:-8] + struct.pack("<Q", points))
    with pytest.raises(BadValue, match="is not a COLMAP model that can be read"):
        read_model(tmp_path)


def test_images_of_one_name_in_two_folders_are_refused(tmp_path: Path) -> None:
    """They would be copied over one another."""
    lens = read_model(STORED / "text").lenses[1]
    images = [ColmapImage(f"{side}/0.png", 1, np.zeros(6)) for side in ("left", "right")]
    (tmp_path / "model").mkdir()
    write_model(tmp_path / "model", ColmapModel({1: lens}, images), binary=False)
    for image in images:
        (tmp_path / image.name).parent.mkdir()
        cv2.imwrite(str(tmp_path / image.name), np.zeros((480, 640), np.uint16))
    with pytest.raises(BadValue, match=r"right/0\.png: would become 0\.png"):
        import_colmap(tmp_path / "model", tmp_path / "set", images=tmp_path, exposure_s=1)
