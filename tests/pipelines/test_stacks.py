"""Planes and stacks as ImageJ and napari see them: the right scale, named and labelled."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

type Command = Callable[..., CompletedProcess[str]]

SWEEP = ("--sweep-mm", "500:700:5", "--method", "backprojection")


def _calibration(path: Path) -> tuple[dict[str, Any], float, NDArray[Any]]:
    """Return ImageJ's description, the distance of samples in its unit, and the pixels (in the axes of the file)."""
    with tifffile.TiffFile(path) as file:
        assert file.is_imagej
        assert file.imagej_metadata is not None
        page = file.pages.first
        count, over = page.tags["XResolution"].value
        assert page.tags["YResolution"].value == (count, over)
        assert page.tags["ResolutionUnit"].value == 1  # none: the description names the unit
        return {**file.imagej_metadata, "axes": file.series[0].axes}, over / count, file.asarray()


def test_a_sweep_is_an_imagej_stack_of_angles(scene: Path, tmp_path: Path, done: Command) -> None:
    out = tmp_path / "out"
    done("reconstruct", scene, *SWEEP, "--out", out)
    said, across, pixels = _calibration(out / "stack.tiff")
    # Samples of the default grid are one detector pixel apart at every depth: 1/f, with f = 120 px at 96 px width
    assert (said["unit"], said["zunit"], said["axes"]) == ("mrad", "mm", "ZYX")
    assert across == pytest.approx(1000 / 120, rel=1e-6)
    assert said["spacing"] == 50.0
    assert -said["zorigin"] * said["spacing"] == 500.0
    assert said["Labels"][0] == "500 mm, 4.167 mm/px"
    assert said["Labels"][-1].startswith("700 mm, ")
    record = json.loads((out / "reconstruction.json").read_text())["planes"][0]
    assert -said["xorigin"] * record["pitch_mm"] == pytest.approx(record["origin_mm"][0])
    assert -said["yorigin"] * record["pitch_mm"] == pytest.approx(record["origin_mm"][1])
    for plane, depth in zip(pixels, (500, 550, 600, 650, 700), strict=True):
        np.testing.assert_array_equal(plane, tifffile.imread(out / f"plane_{depth:07.1f}.tiff"))


def test_planes_of_one_pitch_make_a_stack_in_millimetres(scene: Path, tmp_path: Path, done: Command) -> None:
    done(
        "reconstruct",
        scene,
        "--sweep-mm",
        "600:600.4:3",
        "--pitch-mm",
        5,
        "--method",
        "backprojection",
        "--out",
        tmp_path,
    )
    said, across, _ = _calibration(tmp_path / "stack.tiff")
    assert said["unit"] == "mm"
    assert across == pytest.approx(5.0)
    assert said["spacing"] == pytest.approx(0.2)


def test_a_colour_sweep_is_a_composite(small_options: tuple[object, ...], tmp_path: Path, done: Command) -> None:
    done("simulate", tmp_path / "set", *small_options, "--colour", "bayer")
    done("reconstruct", tmp_path / "set", *SWEEP, "--out", tmp_path / "out")
    said, _, pixels = _calibration(tmp_path / "out" / "stack.tiff")
    assert (said["mode"], said["channels"], said["slices"], said["axes"]) == ("composite", 3, 5, "ZCYX")
    assert len(said["Labels"]) == 15
    plane = tifffile.imread(tmp_path / "out" / "plane_00550.0.tiff")
    np.testing.assert_array_equal(np.moveaxis(pixels[1], 0, 2), plane)


def test_a_plane_states_its_pitch_in_a_unit_that_imagej_knows(scene: Path, tmp_path: Path, done: Command) -> None:
    done("reconstruct", scene, "--depth-mm", 600, "--method", "backprojection", "--out", tmp_path / "out")
    with tifffile.TiffFile(tmp_path / "out" / "plane_00600.0.tiff") as file:
        tags = file.pages.first.tags
        count, over = tags["XResolution"].value
        assert tags["ResolutionUnit"].value == 3  # per centimetre; ImageJ then shows cm
        assert 10 * over / count == pytest.approx(600 / 120, rel=1e-6)
    assert not (tmp_path / "out" / "stack.tiff").exists()


class _Viewer:
    """What napari 0.6 documents of its viewer, so far as it is used: an argument that it does not know is an error."""

    opened: ClassVar["list[_Viewer]"] = []

    def __init__(
        self, *, title: str = "napari", ndisplay: int = 2, order: Any = (), axis_labels: Any = (), show: bool = True
    ):
        self.title = title
        self.images: list[dict[str, Any]] = []
        self.opened.append(self)

    def add_image(
        self,
        data: Any = None,
        *,
        channel_axis: int | None = None,
        affine: Any = None,
        axis_labels: Any = None,
        blending: Any = None,
        colormap: Any = None,
        contrast_limits: Any = None,
        gamma: float = 1.0,
        metadata: Any = None,
        multiscale: Any = None,
        name: Any = None,
        opacity: float = 1.0,
        rgb: Any = None,
        rotate: Any = None,
        scale: Any = None,
        translate: Any = None,
        units: Any = None,
        visible: bool = True,
    ) -> None:
        dimensions = data.ndim - bool(rgb)
        assert len(scale) == len(translate) == len(units) == len(axis_labels) == dimensions
        self.images.append({key: value for key, value in locals().items() if key != "self"})


@pytest.fixture
def viewers(monkeypatch: pytest.MonkeyPatch) -> list[_Viewer]:
    napari: Any = ModuleType("napari")
    napari.Viewer = _Viewer
    napari.run = lambda: None
    monkeypatch.setitem(sys.modules, "napari", napari)
    monkeypatch.setattr(_Viewer, "opened", [])
    return _Viewer.opened


def test_planes_open_in_millimetres(viewers: list[_Viewer], scene: Path, tmp_path: Path, done: Command) -> None:
    methods = ("--method", "backprojection", "--method", "pmlem-osl", "--passes", 2)
    done("reconstruct", scene, "--depth-mm", 500, "--depth-mm", 700, *methods, "--out", tmp_path / "out")
    done("view", tmp_path / "out")
    images = viewers[0].images
    assert [image["name"] for image in images] == [
        "back-projection, 500 mm",
        "back-projection, 700 mm",
        "PMLEM (one-step-late, TV), 500 mm",
        "PMLEM (one-step-late, TV), 700 mm",
    ]
    for image, depth in zip(images, (500, 700, 500, 700), strict=True):
        assert image["scale"] == pytest.approx((depth / 120, depth / 120))
        assert image["units"] == ("mm", "mm")
        # The principal point is beside the middle: 0.6 % of the width to the right, 0.4 % of the height up
        middle = [
            start + image["scale"][0] * (size - 1) / 2 for start, size in zip(image["translate"], (72, 96), strict=True)
        ]
        assert middle == pytest.approx([0.004 * 72 * depth / 120, -0.006 * 96 * depth / 120])
    assert len({image["contrast_limits"] for image in images}) == 1
    assert [image["visible"] for image in images] == [True, False, False, False]


def test_a_sweep_opens_as_one_layer(viewers: list[_Viewer], scene: Path, tmp_path: Path, done: Command) -> None:
    done("reconstruct", scene, *SWEEP, "--out", tmp_path / "out")
    done("view", tmp_path / "out")
    (image,) = viewers[0].images
    assert image["data"].shape == (5, 72, 96)
    assert image["scale"] == pytest.approx((50.0, 1000 / 120, 1000 / 120))
    assert image["translate"][0] == 500.0
    assert image["units"] == ("mm", "mrad", "mrad")
