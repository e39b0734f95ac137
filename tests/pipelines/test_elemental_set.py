"""The elemental set: what is written is read back, and what cannot be is refused in words that name it."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import tifffile
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from faintfield.pipelines.errors import BadValue, InputError, MissingFile, UnknownKey
from faintfield.pipelines.formats.sets.elemental_file import Camera, ElementalSetFile, Noise, View, write_set
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.units import DepthUnit, Units

type SetMaker = Callable[..., Path]
type Edit = Callable[[Path, Callable[[dict[str, Any]], object]], Path]

numbers = st.floats(-1e6, 1e6)
angles = st.floats(-3.2, 3.2)
positive = st.floats(1e-3, 1e6)
names = st.text("abcdefghijklmnopqrstuvwxyzäß_-. 0123456789", min_size=1, max_size=12).map(lambda stem: f"{stem}.tiff")


@st.composite
def elemental_sets(draw: st.DrawFn) -> ElementalSetFile:
    images = draw(st.lists(names, min_size=1, max_size=4, unique=True))
    nodes = draw(st.none() | st.permutations([(0, 0), (0, 1), (1, 0), (2, 7)]))
    reference = draw(st.integers(0, len(images) - 1))
    own_centre = draw(st.booleans())
    views = [
        View(
            image,
            (0.0,) * 6 if index == reference else draw(st.tuples(*[angles] * 3, *[numbers] * 3)),
            nodes[index] if nodes else None,
            draw(numbers) if own_centre else None,
            draw(numbers) if own_centre else None,
        )
        for index, image in enumerate(images)
    ]
    camera = Camera(
        draw(st.tuples(st.integers(1, 9000), st.integers(1, 9000))),
        *draw(st.tuples(positive, positive, numbers, numbers)),
        distortion=tuple(draw(st.lists(st.floats(-1, 1), max_size=8))),
        mosaic=draw(st.sampled_from([None, ("RG", "GB"), ("RGB",)])),
    )
    noise = Noise(
        draw(positive),
        draw(st.floats(0, 1e6)),
        draw(st.none() | numbers),
        draw(st.floats(0, 1e6)),
        draw(st.floats(1e-3, 1)),
        draw(st.none() | positive),
    )
    return ElementalSetFile(
        format=1, exposure_s=draw(positive), reference_view=reference, camera=camera, noise=noise, view=views
    )


@given(elemental_sets())
def test_a_set_that_is_written_is_read_back_as_it_was(settings: ElementalSetFile) -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for view in settings.view:
            (folder / view.image).touch()
        write_set(folder, settings)
        loaded = load_set(folder)
        assert loaded.settings == settings
        assert load_set(folder / "elemental.toml").settings == settings
    assert loaded.noise.offset_dn == ((settings.noise.offset_dn if isinstance(settings.noise, Noise) else None) or 0.0)
    np.testing.assert_array_equal(loaded.poses_rt_cam_ref, [view.rt_cam_ref for view in settings.view])


def _first_view(**values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda settings: settings["view"][0].update(values)


def _second_view(**values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda settings: settings["view"][1].update(values)


def _camera(**values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda settings: settings["camera"].update(values)


def _noise(**values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda settings: settings["noise"].update(values)


def _top(**values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda settings: settings.update(values)


NOT_A_NUMBER = float("nan")

REFUSED: dict[str, tuple[Callable[[dict[str, Any]], object], type[InputError], str]] = {
    "misspelt key of a table": (_camera(fx_pix=1.0), UnknownKey, "'camera.fx_pix' is not a key .* mean 'fx_px'"),
    "wrong type": (_top(exposure_s="long"), BadValue, "exposure_s: Expected `float`, got `str`"),
    "another format": (_top(format=2), BadValue, "format = 2; choose from 1$"),
    "pose that is no number": (
        _second_view(rt_cam_ref=[NOT_A_NUMBER] * 6),
        BadValue,
        r"view\[1\].rt_cam_ref\[0\] = nan",
    ),
    "missing image": (_second_view(image="gone.tiff"), MissingFile, "gone.tiff is named but missing"),
    "repeated image": (_second_view(image="view_0.tiff"), BadValue, "image = view_0.tiff is named by more than one"),
    "repeated node": (_second_view(node=[0, 0]), BadValue, r"node = \(0, 0\) is named by more than one"),
    "path that climbs out": (_second_view(image="../view_1.tiff"), BadValue, "'../view_1.tiff' leaves the folder"),
    "reference that is not at zero": (_first_view(rt_cam_ref=[0, 0, 0, 1, 0, 0]), BadValue, "own is zero"),
    "reference beyond the views": (_top(reference_view=2), BadValue, "reference_view = 2, but there are 2 views"),
    "no exposure": (_top(exposure_s=0.0), BadValue, "exposure_s = 0.0; it must be positive"),
    "ragged mosaic": (_camera(mosaic=["RG", "B"]), BadValue, "camera.mosaic"),
    "no focal length": (_camera(fx_px=0.0), BadValue, "camera: focal lengths must be positive"),
    "no gain": (_noise(gain_dn_per_e=0.0), BadValue, "noise: gain_dn_per_e"),
    "quantum efficiency above one": (_noise(quantum_efficiency=1.5), BadValue, "noise: quantum_efficiency"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_with_the_files_path_and_the_place(
    case: str, make_set: SetMaker, grey_images: Sequence[NDArray[np.uint16]], edit: Edit
) -> None:
    how, failure, words = REFUSED[case]
    folder = make_set(grey_images)
    load_set(folder)
    path = edit(folder, how)
    with pytest.raises(failure, match=words) as refused:
        load_set(folder)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("content", [b"format = ", b"format = 1\nformat = 1\n"])
def test_what_is_no_toml_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "elemental.toml").write_bytes(content)
    with pytest.raises(BadValue, match=r"elemental.toml: is not TOML"):
        load_set(tmp_path)


def test_a_link_that_leads_out_of_the_folder_leaves_it(
    make_set: SetMaker, grey_images: Sequence[NDArray[np.uint16]], tmp_path: Path
) -> None:
    folder = make_set(grey_images)
    (folder / "view_1.tiff").rename(tmp_path / "outside.tiff")
    (folder / "view_1.tiff").symlink_to(tmp_path / "outside.tiff")
    with pytest.raises(BadValue, match=r"'view_1.tiff' leaves the folder"):
        load_set(folder)


@pytest.mark.parametrize(
    ("flat", "words"),
    [
        (np.ones((16, 12), np.float32), "flat.tiff: is 12 x 16 px, the camera 16 x 12 px"),
        (np.full((12, 16), -0.5, np.float32), "flat.tiff: a flat field is .* from -0.5"),
    ],
)
def test_flat_fields_that_do_not_fit_are_refused(
    flat: NDArray[np.float32], words: str, make_set: SetMaker, grey_images: Sequence[NDArray[np.uint16]]
) -> None:
    folder = make_set(grey_images, camera={"flat": "flat.tiff"})
    tifffile.imwrite(folder / "flat.tiff", flat)
    with pytest.raises(InputError, match=rf"{words}"):
        load_set(folder)


def _rectified_set(
    pitch_mm: float, fx_px: float, aligned_px: float, nodes: Sequence[tuple[int, int]], *, with_nodes: bool = True
) -> ElementalSetFile:
    """A grid whose pictures were moved by `aligned_px` from node to node; the first node is the reference."""
    row_0, column_0 = nodes[0]
    views = [
        View(
            f"{row}_{column}.tiff",
            (0.0, 0.0, 0.0, (column_0 - column) * pitch_mm, (row_0 - row) * pitch_mm, 0.0),
            (row, column) if with_nodes else None,
            20.0 + aligned_px * (column - column_0),
            15.0 + aligned_px * (row - row_0),
        )
        for row, column in nodes
    ]
    camera = Camera((40, 30), fx_px, fx_px, 20.0, 15.0)
    return ElementalSetFile(
        format=1, exposure_s=1.0, reference_view=0, camera=camera, noise=Noise(1.0, 0.0), view=views
    )


def _loaded(settings: ElementalSetFile, folder: Path) -> Any:
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
def test_the_depth_of_a_disparity_is_that_of_similar_triangles(
    pitch_mm: float, fx_px: float, aligned_px: float, disparity_px: float, nodes: list[tuple[int, int]]
) -> None:
    assume(abs(aligned_px - disparity_px) > 1e-3)
    with tempfile.TemporaryDirectory() as place:
        loaded = _loaded(_rectified_set(pitch_mm, fx_px, aligned_px, nodes), Path(place))
    # A point at depth z moves by −f p / z from node to node, and by what the picture was moved
    depth_mm = fx_px * pitch_mm / (aligned_px - disparity_px)
    if depth_mm > 0:
        assert loaded.depth_of_disparity(disparity_px) == pytest.approx(depth_mm, rel=1e-9)
    else:
        with pytest.raises(BadValue, match="no plane in front of the cameras"):
            loaded.depth_of_disparity(disparity_px)


@pytest.mark.parametrize(
    ("unit", "depth", "both"),
    [
        ("disparity_px", "disparity 0 px", "disparities -1.5 to 0 px"),
    ],
)
def test_depths_are_worded_in_the_unit_of_the_set(tmp_path: Path, unit: DepthUnit, depth: str, both: str) -> None:
    # A point at depth z moves by 2.5 - 10 * 100 / z px from node to node
    settings = _rectified_set(10.0, 100.0, 2.5, [(0, 0), (0, 1), (1, 0)])
    loaded = _loaded(msgspec.structs.replace(settings, units=Units(depth=unit)), tmp_path)
    assert loaded.depth_text(400.0) == depth
    assert loaded.depth_range_text(250.0, 400.0) == both
    assert loaded.disparity_of_depth(250.0) == pytest.approx(-1.5)
    assert loaded.depth_of_disparity(-1.5) == pytest.approx(250.0)


def test_a_disparity_beyond_infinity_is_refused_with_that_of_infinity(tmp_path: Path) -> None:
    loaded = _loaded(_rectified_set(10.0, 100.0, 2.5, [(0, 0), (0, 1), (1, 0)]), tmp_path)
    with pytest.raises(BadValue, match=r"disparity of 3 px .* below 2\.5 px, that of infinitely far"):
        loaded.depth_of_disparity(3.0)
