"""The numbers of the viewer: as fine as stated, within their budget, and the best pictures first."""

import base64
import json
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.formats.image_files import Spacing, write_plane
from faintfield.pipelines.formats.results.records import Certificate, Method, PlaneRecord, PriorRecord
from faintfield.pipelines.pages.report_pictures import PlaneSections, plane_sections
from faintfield.pipelines.pages.report_planes import Plane, column_titles
from faintfield.pipelines.pages.viewer_data import (
    UNKNOWN_LEVEL,
    Fineness,
    Packed,
    ViewerData,
    ViewerPicture,
    pack,
    viewer_of,
)
from tests.pipelines.conftest import run_undrawn
from tests.pipelines.forms import read_record


def _levels(png: bytes) -> NDArray[np.int64]:
    both = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert both is not None
    ordered = both if both.ndim == 2 else both[:, :, ::-1]
    high, low = np.split(ordered.astype(np.int64), 2)
    return np.asarray(256 * high + low)


def _picture_levels(picture: ViewerPicture) -> NDArray[np.int64]:
    levels = _levels(base64.b64decode(picture["src"].partition(",")[2]))
    return levels if levels.ndim == 2 else levels[:, :, 0]


def _numbers(packed: Packed) -> NDArray[np.float64]:
    return np.asarray(packed.low + packed.step * _levels(packed.png))


@pytest.mark.parametrize("shape", [(3, 5), (4, 7, 3)])
def test_packed_numbers_come_back_within_half_step(shape: tuple[int, ...]) -> None:
    numbers = np.random.default_rng(1).normal(2.0, 30.0, shape).astype(np.float32)
    step = 0.01
    assert np.abs(_numbers(pack(numbers, step)) - numbers).max() <= 0.5 * step * (1 + 1e-6)
    finest = float(np.ptp(numbers)) / 65534
    assert _levels(pack(numbers, finest).png).max() == 65534


def test_step_of_overflowing_numbers_is_finite() -> None:
    plane = np.array([[-3e38, 3e38, np.inf, np.inf, np.nan], [1.0, 2.0, 3.0, 4.0, 5.0]], np.float32)
    step = Fineness(1 / 16, 2**-13).step(plane)
    assert step == pytest.approx(6e38 / 2**13)
    found = _numbers(pack(plane, step))
    assert abs(found[0, 1] - 3e38) <= step


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_what_is_no_number_is_marked(bad: float) -> None:
    levels = _levels(pack(np.array([[1.0, bad, 2.0]], np.float32), 0.5).png)
    np.testing.assert_array_equal(levels, [[0, UNKNOWN_LEVEL, 2]])
    np.testing.assert_array_equal(_numbers(pack(np.full((2, 2), 7.5, np.float32), 0.0)), 7.5)
    assert (_levels(pack(np.full((2, 2), bad, np.float32), 0.0).png) == UNKNOWN_LEVEL).all()


def _plane(folder: Path, method: Method, depth_mm: float, pixels: NDArray[np.float32]) -> Plane:
    path = folder / f"{method}_{depth_mm:g}.tiff"
    write_plane(path, pixels, Spacing(0.5))
    place = {"depth_mm": depth_mm, "pitch_mm": 0.5, "origin_mm": (-10.0, 20.0), "file": path.name, "channel": "grey"}
    solution = {"penalty_weight": None, "penalty_weight_chosen": "", "passes": 1, "certificate": None, "flux_e": 1.0}
    record = msgspec.convert({"method": method, **place, **solution}, PlaneRecord)
    return Plane(method, method, "stated", depth_mm, path, [record])


def _pictures(planes: list[Plane]) -> list[ViewerPicture]:
    shown = viewer_of(planes, PlaneSections(white=1.0), None)
    assert shown is not None
    return shown["pictures"]


def test_small_plane_is_fine_and_large_one_binned(tmp_path: Path) -> None:
    plane = np.random.default_rng(1).normal(0.5, 0.4, (40, 60)).astype(np.float32)
    (one,) = _pictures([_plane(tmp_path, "pmlem", 500.0, plane)])
    assert one["step"] == pytest.approx(float(np.ptp(plane)) / 65534)
    assert (one["bins"], one["pitch"], one["origin"]) == (1, 0.5, (-10.0, 20.0))
    plane = np.add.outer(np.arange(1400, dtype=np.float32), 2 * np.arange(1601, dtype=np.float32))
    (one,) = _pictures([_plane(tmp_path, "pmlem", 500.0, plane)])
    assert (one["bins"], one["pitch"], one["origin"]) == (2, 1.0, (-9.75, 20.25))
    levels = _picture_levels(one)
    assert levels.shape == (700, 800)
    shown = one["low"] + one["step"] * levels
    expected = plane[:1400, :1600].reshape(700, 2, 800, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(shown, expected, atol=0.51 * one["step"] + 1e-3)


def test_plane_is_read_with_its_standard_deviation(tmp_path: Path) -> None:
    light = np.eye(6, 8, dtype=np.float32)
    plane = _plane(tmp_path, "pmlem", 500.0, light)
    write_plane(tmp_path / "sigma.tiff", 0.1 + light, Spacing(0.5))
    record = msgspec.structs.replace(plane.records[0], sigma_file="sigma.tiff")
    pictures = _pictures([_plane(tmp_path, "mlem", 500.0, light), replace(plane, records=[record])])
    (known,) = [picture for picture in pictures if "sigma" in picture]
    assert (known["kind"], known["title"]) == ("light", "PMLEM")
    assert pictures[known["sigma"]]["title"] == "σ of PMLEM"


def test_samples_without_number_are_saturated_by_record(tmp_path: Path) -> None:
    plane = _plane(tmp_path, "pmlem", 500.0, np.full((4, 6), np.nan, np.float32))
    record = msgspec.structs.replace(plane.records[0], saturated_share=0.1, unknown_share=0.2)
    assert _pictures([replace(plane, records=[record])])[0]["saturated"]
    assert "saturated" not in _pictures([plane])[0]


def test_priors_are_named_where_they_differ(tmp_path: Path) -> None:
    light = np.eye(6, 8, dtype=np.float32)
    alone, joint = (_plane(tmp_path, method, 500.0, light) for method in ("pmlem", "occlusion"))
    by_tv, by_auto = (
        [msgspec.structs.replace(plane.records[0], prior=PriorRecord(name=name))]
        for plane, name in ((alone, "tv"), (joint, "auto"))
    )
    both = column_titles([replace(alone, records=by_tv), replace(joint, records=by_auto)])
    assert list(both.values()) == ["PMLEM, prior: tv", "PMLEM, all planes together, with occlusion, prior: auto"]
    assert list(column_titles([replace(alone, records=by_tv)]).values()) == ["PMLEM"]


def test_certificates_of_a_plane_are_by_colour(tmp_path: Path) -> None:
    plane = _plane(tmp_path, "pmlem", 500.0, np.eye(6, 8, dtype=np.float32))
    channels = ("red", "green", "blue")
    records = [
        msgspec.structs.replace(plane.records[0], channel=channel, certificate=Certificate(value=value, reached=True))
        for channel, value in zip(channels, (0.01, 0.02, 0.03), strict=True)
    ]
    shown = plane_sections([replace(plane, records=records)], [])
    ((label, bounds),) = shown.certificates
    assert (label, shown.channels) == ("500 mm", list(channels))
    assert [bounds[channel].value for channel in channels] == [0.01, 0.02, 0.03]


def test_joint_planes_stand_beside_best_found_alone(tmp_path: Path) -> None:
    methods: list[Method] = ["backprojection", "pmlem", "occlusion"]
    light = np.eye(6, 8, dtype=np.float32)
    planes = [_plane(tmp_path, method, depth_mm, light) for method in methods for depth_mm in (500.0, 700.0)]
    shown = viewer_of(planes, PlaneSections(white=1.0), None)
    assert shown is not None
    first, second = (shown["pictures"][index] for index in shown["first"])
    assert first["title"] == "PMLEM"
    assert second["title"].startswith("PMLEM, all planes together")
    assert first["label"] == second["label"] == "500 mm"


def test_page_of_set_states_numbers_units_and_places(simulated_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "</script><script>alert(1)</script>".replace("/", "∕")
    run_undrawn("reconstruct", simulated_scene, "--out", out, "--depth-mm", 500, "--method", "backprojection")
    page = (out / "report.html").read_text()
    assert "<script>alert(1)" not in page
    data: ViewerData = json.loads(page.partition('id="viewer-data">')[2].partition("</script>")[0])
    (light,) = (picture for picture in data["pictures"] if picture["kind"] == "light")
    plane = tifffile.imread(out / "plane_00500.0.tiff")
    np.testing.assert_allclose(
        light["low"] + light["step"] * _picture_levels(light), plane, atol=0.5 * light["step"] * 1.01
    )
    assert (light["unit"], data["length"]) == ("e⁻ per pixel", "mm")
    record = read_record(out)["planes"][0]
    assert (light["pitch"], light["origin"]) == (record["pitch_mm"], record["origin_mm"])
