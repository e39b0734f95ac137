"""Planes and stacks as ImageJ and napari see them: the right scale, named and labelled."""

import re
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines import pages
from tests.pipelines.conftest import Command
from tests.pipelines.forms import read_record

_PAGES = Path(pages.__file__).parent


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


def test_sweep_is_imagej_stack_of_angles(sweep: Path) -> None:
    description, across, pixels = _calibration(sweep / "stack.tiff")
    # Samples of the default grid are one detector pixel apart at every depth: 1/f, with f = 120 px at 96 px width
    assert (description["unit"], description["zunit"], description["axes"]) == ("mrad", "mm", "ZYX")
    assert across == pytest.approx(1000 / 120, rel=1e-6)
    assert description["spacing"] == 50.0
    assert -description["zorigin"] * description["spacing"] == 500.0
    assert description["Labels"][0] == "500 mm, 4.167 mm/px"
    assert description["Labels"][-1].startswith("700 mm, ")
    record = read_record(sweep)["planes"][0]
    assert -description["xorigin"] * record["pitch_mm"] == pytest.approx(record["origin_mm"][0])
    assert -description["yorigin"] * record["pitch_mm"] == pytest.approx(record["origin_mm"][1])
    for plane, depth in zip(pixels, (500, 550, 600, 650, 700), strict=True):
        np.testing.assert_array_equal(plane, tifffile.imread(sweep / f"plane_{depth:07.1f}.tiff"))


def test_planes_of_one_pitch_are_stacked_in_mm(scene: Path, tmp_path: Path, done: Command) -> None:
    words = ("--sweep-mm", "600:650:3", "--pitch-mm", 5, "--method", "backprojection")
    done("reconstruct", scene, *words, "--out", tmp_path)
    description, across, pixels = _calibration(tmp_path / "stack.tiff")
    assert description["unit"] == "mm"
    assert across == pytest.approx(5.0)
    assert description["spacing"] == pytest.approx(25.0)
    # A sample of a plane lies in the stack where its x and y say, and beyond the smaller planes nothing is known
    origin = description["xorigin"], description["yorigin"]
    for stacked, record in zip(pixels, read_record(tmp_path)["planes"], strict=True):
        plane = tifffile.imread(tmp_path / record["file"])
        column, row = (round(start / 5 + at) for start, at in zip(record["origin_mm"], origin, strict=True))
        np.testing.assert_array_equal(stacked[row : row + plane.shape[0], column : column + plane.shape[1]], plane)
        assert np.isnan(stacked).sum() == stacked.size - plane.size
    assert np.isnan(pixels[0]).any()
    with tifffile.TiffFile(tmp_path / "plane_00600.0.tiff") as file:
        assert file.pages.first.tags["ResolutionUnit"].value == 3  # per centimetre; ImageJ then shows cm
    done("reconstruct", scene, "--depth-mm", 600, "--method", "backprojection", "--out", tmp_path)
    assert not (tmp_path / "stack.tiff").exists()


def test_colour_sweep_is_composite(colour_set: Path, tmp_path: Path, done: Command) -> None:
    words = ("--sweep-mm", "500:600:3", "--method", "backprojection")
    done("reconstruct", colour_set, *words, "--out", tmp_path / "out")
    description, _, pixels = _calibration(tmp_path / "out" / "stack.tiff")
    assert [description[key] for key in ("mode", "channels", "slices", "axes")] == ["composite", 3, 3, "ZCYX"]
    assert len(description["Labels"]) == 9
    plane = tifffile.imread(tmp_path / "out" / "plane_00550.0.tiff")
    np.testing.assert_array_equal(np.moveaxis(pixels[1], 0, 2), plane)


class _Viewer:
    """The arguments that napari 0.6 documents of its viewer: one that it does not know is an error."""

    opened: ClassVar["list[_Viewer]"] = []

    def __init__(
        self, *, title: str = "napari", ndisplay: int = 2, order: Any = (), axis_labels: Any = (), show: bool = True
    ):
        self.title = title
        self.images: list[dict[str, Any]] = []
        self.opened.append(self)

    def add_image(self, data: Any, **options: Any) -> None:
        assert options.keys() <= {
            *("channel_axis", "affine", "axis_labels", "blending", "colormap", "contrast_limits", "gamma", "metadata"),
            *("multiscale", "name", "opacity", "rgb", "rotate", "scale", "translate", "units", "visible"),
        }
        dimensions = data.ndim - bool(options.get("rgb"))
        assert {len(options[key]) for key in ("scale", "translate", "units", "axis_labels")} == {dimensions}
        self.images.append({"data": data, "visible": True} | options)


@pytest.fixture
def viewers(monkeypatch: pytest.MonkeyPatch) -> list[_Viewer]:
    napari: Any = ModuleType("napari")
    napari.Viewer = _Viewer
    napari.run = lambda: None
    monkeypatch.setitem(sys.modules, "napari", napari)
    monkeypatch.setattr(_Viewer, "opened", [])
    return _Viewer.opened


def test_planes_open_in_mm(viewers: list[_Viewer], scene: Path, tmp_path: Path, done: Command) -> None:
    methods = ("--method", "backprojection", "--method", "mlem", "--passes", 2)
    done("reconstruct", scene, "--depth-mm", 500, "--depth-mm", 700, *methods, "--out", tmp_path / "out")
    done("view", tmp_path / "out")
    images = viewers[0].images
    names = [(method, depth) for method in ("back-projection", "MLEM") for depth in (500, 700)]
    for image, (method, depth) in zip(images, names, strict=True):
        assert image["name"] == f"{method}, {depth} mm"
        assert image["scale"] == pytest.approx((depth / 120, depth / 120))
        assert image["units"] == ("mm", "mm")
        # The principal point is beside the middle: 0.6 % of the width to the right, 0.4 % of the height up
        middle = image["translate"] + image["scale"][0] * (np.array([72, 96]) - 1) / 2
        assert middle == pytest.approx([0.004 * 72 * depth / 120, -0.006 * 96 * depth / 120])
    assert len({image["contrast_limits"] for image in images}) == 1
    assert [image["visible"] for image in images] == [True, False, False, False]


def test_sweep_opens_as_one_layer(viewers: list[_Viewer], sweep: Path, done: Command) -> None:
    done("view", sweep)
    (image,) = viewers[0].images
    assert image["data"].shape == (5, 72, 96)
    assert image["scale"] == pytest.approx((50.0, 1000 / 120, 1000 / 120))
    assert image["translate"][0] == 500.0
    assert image["units"] == ("mm", "mrad", "mrad")


def test_results_open_when_dropped_into_napari(sweep: Path, scene: Path, tmp_path: Path, done: Command) -> None:
    (python_name,) = re.findall(r"python_name: (\S+)", (_PAGES / "napari.yaml").read_text())
    module, _, function = python_name.partition(":")
    napari_reader = getattr(import_module(module), function)
    for path in (str(sweep), [str(sweep / "reconstruction.json")]):
        ((pixels, parameters, kind),) = napari_reader(path)(path)
        assert (kind, pixels.shape) == ("image", (5, 72, 96))
        assert parameters["translate"][0] == 500.0
        assert parameters["units"] == ("mm", "mrad", "mrad")
    methods = ("--method", "backprojection", "--method", "mlem", "--passes", 2)
    done("reconstruct", scene, "--depth-mm", 500, *methods, "--out", tmp_path)
    names = [parameters["name"] for _, parameters, _ in napari_reader(str(tmp_path))(str(tmp_path))]
    assert names == ["back-projection, 500 mm", "MLEM, 500 mm"]
    assert napari_reader(str(scene)) is None
    assert napari_reader([str(sweep), str(scene)]) is None
