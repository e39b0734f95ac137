"""The elemental set: what is written is read back, and what cannot be is refused in words that name it."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import tifffile
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from faintfield.pipelines.errors import BadValue, InputError, MissingFile, UnknownKey
from faintfield.pipelines.formats.sets.elemental_file import Camera, ElementalSetFile, Noise, View, write_set
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.units import Units
from tests.pipelines.conftest import Edit, SetMaker


@pytest.mark.parametrize("own_centres", [False, True])
@pytest.mark.parametrize("mosaic", [None, ("RG", "GB"), ("RGB",)])
def test_written_set_is_read_back(own_centres: bool, mosaic: tuple[str, ...] | None, tmp_path: Path) -> None:
    centre = (-3.25, 1e6) if own_centres else (None, None)
    views = [
        View("äß_-. 0.tiff", (0.1, -3.2, 1e-7, 1e6, -1 / 3, 0.0), (2, 7), *centre),
        View("b.tiff", (0.0,) * 6, (0, 1), *centre),
    ]
    camera = Camera((9000, 1), 1e-3, 1e6, -0.5, 4 / 3, distortion=(-1.0, 0.1, 1e-9), mosaic=mosaic)
    noise = Noise(2.5, 0.0, None if own_centres else -7.25, 0.125, 1.0, 4095.0 if own_centres else None)
    file = ElementalSetFile(format=1, exposure_s=1 / 3, reference_view=1, camera=camera, noise=noise, view=views)
    elemental_set = _written_set(file, tmp_path)
    assert elemental_set.settings == file
    assert load_set(tmp_path / "elemental.toml").settings == file
    assert elemental_set.noise.offset_dn == (noise.offset_dn or 0.0)
    np.testing.assert_array_equal(elemental_set.poses_rt_cam_ref, [view.rt_cam_ref for view in views])


REFUSED: dict[str, tuple[str, dict[str, Any], type[InputError], str]] = {
    "misspelt key of a table": ("camera", {"fx_pix": 1.0}, UnknownKey, "'camera.fx_pix' is not a key .* mean 'fx_px'"),
    "another format": ("", {"format": 2}, BadValue, "format = 2; choose from 1$"),
    "no number": ("1", {"rt_cam_ref": [float("nan")] * 6}, BadValue, r"view\[1\].rt_cam_ref\[0\] = nan"),
    "missing image": ("1", {"image": "gone.tiff"}, MissingFile, "gone.tiff is named but missing"),
    "repeated image": ("1", {"image": "view_0.tiff"}, BadValue, "image = view_0.tiff is named by more than one"),
    "repeated node": ("1", {"node": [0, 0]}, BadValue, r"node = \(0, 0\) is named by more than one"),
    "path that climbs out": ("1", {"image": "../view_1.tiff"}, BadValue, "'../view_1.tiff' leaves the folder"),
    "link that leads out": ("1", {"image": "link.tiff"}, BadValue, "'link.tiff' leaves the folder"),
    "reference not at zero": ("0", {"rt_cam_ref": [0, 0, 0, 1, 0, 0]}, BadValue, "own is zero"),
    "reference beyond the views": ("", {"reference_view": 2}, BadValue, "reference_view = 2, but there are 2 views"),
    "no exposure": ("", {"exposure_s": 0.0}, BadValue, "exposure_s = 0.0; it must be positive"),
    "ragged mosaic": ("camera", {"mosaic": ["RG", "B"]}, BadValue, "camera.mosaic"),
    "no focal length": ("camera", {"fx_px": 0.0}, BadValue, "camera: focal lengths must be positive"),
    "no gain": ("noise", {"gain_dn_per_e": 0.0}, BadValue, "noise: gain_dn_per_e"),
    "efficiency above one": ("noise", {"quantum_efficiency": 1.5}, BadValue, "noise: quantum_efficiency"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_settings_are_refused_with_their_place(
    case: str, make_set: SetMaker, grey_images: Sequence[NDArray[np.uint16]], edit: Edit, tmp_path: Path
) -> None:
    table, values, failure, words = REFUSED[case]
    folder = make_set(grey_images)
    (tmp_path / "outside.tiff").touch()
    (folder / "link.tiff").symlink_to(tmp_path / "outside.tiff")
    load_set(folder)

    def change(settings: dict[str, Any]) -> None:
        part = settings["view"][int(table)] if table.isdigit() else settings[table] if table else settings
        part.update(values)

    path = edit(folder, change)
    with pytest.raises(failure, match=words) as refused:
        load_set(folder)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)
    path.write_text("format = 1\nformat = 1\n")
    with pytest.raises(BadValue, match=r"elemental.toml: is not TOML"):
        load_set(folder)


def test_unfit_flat_fields_are_refused(make_set: SetMaker, grey_images: Sequence[NDArray[np.uint16]]) -> None:
    folder = make_set(grey_images, camera={"flat": "flat.tiff"})
    for flat, words in (
        (np.ones((16, 12), np.float32), "flat.tiff: is 12 x 16 px, the camera 16 x 12 px"),
        (np.full((12, 16), -0.5, np.float32), "flat.tiff: a flat field is .* from -0.5"),
    ):
        tifffile.imwrite(folder / "flat.tiff", flat)
        with pytest.raises(InputError, match=words):
            load_set(folder)


def _rectified_set(
    pitch_mm: float, fx_px: float, aligned_px: float, nodes: Sequence[tuple[int, int]]
) -> ElementalSetFile:
    """A grid whose pictures were moved by `aligned_px` from node to node; the first node is the reference."""
    row_0, column_0 = nodes[0]
    steps = [(column - column_0, row - row_0) for row, column in nodes]
    poses = [(0.0, 0.0, 0.0, -right * pitch_mm, -down * pitch_mm, 0.0) for right, down in steps]
    views = [
        View(f"{node}.tiff", pose, node, 20.0 + aligned_px * right, 15.0 + aligned_px * down)
        for node, pose, (right, down) in zip(nodes, poses, steps, strict=True)
    ]
    camera, noise = Camera((40, 30), fx_px, fx_px, 20.0, 15.0), Noise(1.0, 0.0)
    return ElementalSetFile(format=1, exposure_s=1.0, reference_view=0, camera=camera, noise=noise, view=views)


def _written_set(settings: ElementalSetFile, folder: Path) -> Any:
    for view in settings.view:
        (folder / view.image).touch()
    write_set(folder, settings)
    return load_set(folder)


@given(
    pitch_mm=st.floats(0.1, 100),
    fx_px=st.floats(10, 5000),
    aligned_px=st.floats(-5, 5),
    disparity_px=st.floats(-10, 10),
    nodes=st.permutations([(0, 0), (0, 1), (3, 1), (1, 2)]),
)
@settings(max_examples=25)
def test_depth_of_disparity_follows_similar_triangles(
    pitch_mm: float, fx_px: float, aligned_px: float, disparity_px: float, nodes: list[tuple[int, int]]
) -> None:
    assume(abs(aligned_px - disparity_px) > 1e-3)
    with tempfile.TemporaryDirectory() as place:
        elemental_set = _written_set(_rectified_set(pitch_mm, fx_px, aligned_px, nodes), Path(place))
    # A point at depth z moves by −f p / z from node to node, and by what the picture was moved
    depth_mm = fx_px * pitch_mm / (aligned_px - disparity_px)
    if depth_mm > 0:
        assert elemental_set.depth_of_disparity(disparity_px) == pytest.approx(depth_mm, rel=1e-9)
    else:
        with pytest.raises(BadValue, match="no plane in front of the cameras"):
            elemental_set.depth_of_disparity(disparity_px)


def test_depths_are_worded_in_unit_of_set(tmp_path: Path) -> None:
    # A point at depth z moves by 2.5 - 10 * 100 / z px from node to node
    settings = _rectified_set(10.0, 100.0, 2.5, [(0, 0), (0, 1), (1, 0)])
    elemental_set = _written_set(msgspec.structs.replace(settings, units=Units(depth="disparity_px")), tmp_path)
    assert elemental_set.depth_text(400.0) == "disparity 0 px"
    assert elemental_set.depths_text(250.0, 400.0, join=" to ") == "disparities -1.5 to 0 px"
    assert elemental_set.disparity_of_depth(250.0) == pytest.approx(-1.5)
    assert elemental_set.depth_of_disparity(-1.5) == pytest.approx(250.0)
    with pytest.raises(BadValue, match=r"disparity of 3 px .* below 2\.5 px, that of infinitely far"):
        elemental_set.depth_of_disparity(3.0)
