"""`export zarr`: what the libraries of OME-Zarr and zarr read is what was reconstructed, where it is."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from tests.pipelines.conftest import Command, assert_refused
from tests.pipelines.forms import read_record

zarr = pytest.importorskip("zarr")
ome_zarr_models = pytest.importorskip("ome_zarr_models")


def _image(folder: Path) -> tuple[Any, Any]:
    """Return the group and its metadata, which the library has checked against the specification."""
    group = zarr.open_group(folder, mode="r")
    image = ome_zarr_models.open_ome_zarr(group)
    assert type(image).__name__ == "Image"
    assert image.ome_attributes.version == "0.5"
    (multiscale,) = image.ome_attributes.multiscales
    return group, multiscale


def _scales(multiscale: Any) -> list[tuple[list[float], list[float]]]:
    pairs = [dataset.coordinateTransformations for dataset in multiscale.datasets]
    return [(list(scale.scale), list(translation.translation)) for scale, translation in pairs]


def test_sweep_is_in_mm_and_milliradians(sweep: Path, tmp_path: Path, done: Command) -> None:
    stack = tmp_path / "sweep.ome.zarr"
    done("export", "zarr", sweep, stack)
    group, multiscale = _image(stack)
    assert [(axis.name, axis.type, axis.unit) for axis in multiscale.axes] == [
        ("c", "channel", None),
        ("z", "space", "millimeter"),
        ("y", "space", None),  # no length is right at every depth
        ("x", "space", None),
    ]
    ((scale, translation),) = _scales(multiscale)
    first = read_record(sweep)["planes"][0]
    assert scale[:2] == [1.0, pytest.approx(50.0)]
    assert translation[:2] == [0.0, 500.0]
    for axis, start in ((3, first["origin_mm"][0]), (2, first["origin_mm"][1])):
        assert scale[axis] * first["depth_mm"] / 1e3 == pytest.approx(first["pitch_mm"])
        assert translation[axis] * first["depth_mm"] / 1e3 == pytest.approx(start)
    assert group.attrs["faintfield"]["axes"] == {"z": "mm", "y": "mrad", "x": "mrad"}
    pixels = group["0"][:]
    assert pixels.dtype == np.float32
    np.testing.assert_array_equal(
        pixels[0], [tifffile.imread(sweep / plane["file"]) for plane in read_record(sweep)["planes"]]
    )


def test_large_colour_planes_have_several_resolutions(
    colour_set: Path, tmp_path: Path, done: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("faintfield.pipelines.formats.exchange.zarr._COARSEST_PX", 20)
    monkeypatch.setattr("faintfield.pipelines.formats.exchange.zarr._CHUNK_PX", 40)
    out, stack = tmp_path / "out", tmp_path / "sweep.ome.zarr"
    done("reconstruct", colour_set, "--out", out, "--depth-mm", 500, "--method", "backprojection")
    done("export", "zarr", out, stack)
    group, multiscale = _image(stack)
    plane = np.moveaxis(tifffile.imread(out / "plane_00500.0.tiff"), 2, 0)
    assert [dataset.path for dataset in multiscale.datasets] == ["0", "1", "2"]
    assert [group[level].shape for level in "012"] == [(3, 1, 48, 64), (3, 1, 24, 32), (3, 1, 12, 16)]
    assert group["0"].chunks == (1, 1, 40, 40)
    np.testing.assert_array_equal(group["0"][:, 0], plane)
    # A sample of any resolution is the mean of those it stands for, and lies in their middle
    finest = _scales(multiscale)[0]
    for level, (scale, translation) in zip((1, 2), _scales(multiscale)[1:], strict=True):
        size = 2**level
        block = plane[1, 2 * size : 3 * size, 5 * size : 6 * size]
        assert group[str(level)][1, 0, 2, 5] == pytest.approx(block.mean(), rel=1e-5)
        for axis, index in ((2, 2), (3, 5)):
            middle = finest[1][axis] + finest[0][axis] * (index * size + (size - 1) / 2)
            assert translation[axis] + scale[axis] * index == pytest.approx(middle)


def test_unequal_steps_make_an_axis_without_unit(
    simulated_scene: Path, tmp_path: Path, done: Command, faintfield: Command
) -> None:
    out, stack = tmp_path / "out", tmp_path / "stack.zarr"
    words = ("reconstruct", simulated_scene, "--method", "backprojection", "--out", out)
    done(*words, "--depth-mm", 500, "--depth-mm", 550, "--depth-mm", 700)
    assert "the axis z counts the planes" in done("export", "zarr", out, stack).stderr
    group, multiscale = _image(stack)
    assert [axis.unit for axis in multiscale.axes] == [None] * 4
    ((scale, translation),) = _scales(multiscale)
    assert (scale[1], translation[1]) == (1.0, 0.0)
    stated = group.attrs["faintfield"]
    assert stated["axes"] == {"z": "index", "y": "mrad", "x": "mrad"}
    assert [plane["depth_mm"] for plane in stated["planes"]] == [500.0, 550.0, 700.0]
    done(*words, "--depth-mm", 500, "--method", "mlem")
    assert_refused(faintfield("export", "zarr", out, tmp_path / "other"), "BadValue", "calls or methods; name one")
    assert not (tmp_path / "other").exists()


def test_planes_of_one_pitch_are_in_mm(
    simulated_scene: Path, tmp_path: Path, done: Command, faintfield: Command
) -> None:
    out, stack = tmp_path / "mm", tmp_path / "stack.zarr"
    words = ("--method", "backprojection", "--sweep-mm", "500:501:2", "--pitch-mm", 5)
    done("reconstruct", simulated_scene, "--out", out, *words)
    done("export", "zarr", out, stack)
    _, multiscale = _image(stack)
    assert [axis.unit for axis in multiscale.axes] == [None, "millimeter", "millimeter", "millimeter"]
    ((scale, translation),) = _scales(multiscale)
    assert scale == [1.0, pytest.approx(1.0), 5.0, 5.0]
    assert translation[2:] == [pytest.approx(value) for value in read_record(out)["planes"][0]["origin_mm"][::-1]]
    record = read_record(out)
    del record["record_sha256"]
    record["planes"][1]["origin_mm"][0] += 2.0
    (out / "reconstruction.json").write_text(json.dumps(record))
    assert_refused(faintfield("export", "zarr", out, tmp_path / "other"), "BadValue", "not whole samples apart")
