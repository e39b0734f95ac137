"""`report`: one page that needs nothing but itself."""

import base64
import json
import re
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.image_files import grey_levels, white_level
from tests.pipelines.by_hand import write_by_hand
from tests.pipelines.conftest import Command, drawing_nothing

pytestmark = pytest.mark.usefixtures("undrawn")

METHOD_TITLES = {"backprojection": "back-projection", "pmlem-osl": "PMLEM (one-step-late, TV)"}
VOID = {"meta", "img", "input", "br", "hr", "link"}


class _Page(HTMLParser):
    """What is on a page: its elements, its words, and whether every element is closed in turn."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words = ""
        self.mistakes: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.mistakes.append(f"</{tag}> at line {self.getpos()[0]}")

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in ("script", "style"):
            self.words += data

    def attributes(self, tag: str, name: str) -> list[str]:
        return [attributes[name] or "" for found, attributes in self.elements if found == tag and name in attributes]


@pytest.fixture(scope="module")
def original(simulated_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three depths by two methods, with a focus curve; to be read only."""
    out = tmp_path_factory.mktemp("report") / "<planes & more>"
    methods = [word for name in METHOD_TITLES for word in ("--method", name)]
    words = ["--sweep-mm", "500:700:3", *methods, "--passes", "3"]
    with drawing_nothing():
        assert run(["reconstruct", str(simulated_scene), "--out", str(out), *words]) == 0
    return out


@pytest.fixture
def planes(original: Path, tmp_path: Path) -> Path:
    """A copy of the results that a test may change."""
    return Path(shutil.copytree(original, tmp_path / original.name))


@pytest.fixture(scope="module")
def text(original: Path) -> str:
    return (original / "report.html").read_text()


@pytest.fixture(scope="module")
def page(text: str) -> _Page:
    return _Page(text)


def test_page_is_well_formed_and_fetches_nothing(text: str, page: _Page) -> None:
    assert text.startswith("<!doctype html>")
    assert page.mistakes == []
    assert page.open == []
    (policy,) = [a["content"] for tag, a in page.elements if tag == "meta" and "http-equiv" in a]
    assert policy is not None
    assert policy.startswith("default-src 'none'; img-src data:;")


def test_page_needs_nothing_from_elsewhere(text: str, page: _Page) -> None:
    addresses = set(re.findall(r"[a-z]+://[^\s\"'<>)]+", text))
    names_of_formats = ("http://www.w3.org/", "http://purl.org/dc/", "http://creativecommons.org/ns#")
    assert {address for address in addresses if not address.startswith(names_of_formats)} == set()
    for tag in {tag for tag, _ in page.elements}:
        for attribute in ("src", "href", "xlink:href", "srcset", "action", "data", "poster"):
            for target in page.attributes(tag, attribute):
                assert target.startswith(("data:image/", "#"))
    assert not {"link", "iframe", "object", "embed", "base"} & {tag for tag, _ in page.elements}
    assert not re.search(r"@import|\bfetch\(|XMLHttpRequest|import\(", text)
    for target in re.findall(r"url\(([^)]*)\)", text):
        assert target.strip("'\"").startswith(("#", "data:"))


def test_every_picture_can_be_decoded(text: str, page: _Page) -> None:
    sources = {*page.attributes("img", "src"), *re.findall(r'"src": "(data:[^"]+)"', text)}
    assert len(sources) >= 3 + 3 * 2 + 3 * 2  # the set, the planes side by side, the slider
    for source in sources:
        kind, content = source.split(";base64,")
        assert kind in ("data:image/png", "data:image/jpeg", "data:image/webp")
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_UNCHANGED)
        assert picture is not None


def test_page_has_all_methods_and_depths(text: str, page: _Page) -> None:
    alternatives = page.attributes("img", "alt")
    for title in METHOD_TITLES.values():
        for depth in (500, 600, 700):
            assert f"{title} at {depth} mm" in alternatives
    found = re.search(r"const columns = (.*);\n", text)
    assert found is not None
    columns = json.loads(found[1])
    assert [column["title"] for column in columns] == list(METHOD_TITLES.values())
    for column in columns:
        assert [plane["depth"] for plane in column["planes"]] == [500.0, 600.0, 700.0]


def test_planes_share_grey_scale_of_least_noisy_method(page: _Page, original: Path) -> None:
    planes = {
        (name, depth): tifffile.imread(original / name / f"plane_{depth:07.1f}.tiff")
        for name in METHOD_TITLES
        for depth in (500.0, 600.0, 700.0)
    }
    white = min(max(white_level(planes[name, depth]) for depth in (500.0, 600.0, 700.0)) for name in METHOD_TITLES)
    assert f"{white:.3g} e⁻ per pixel" in page.words
    shown = {a["alt"]: a["src"] or "" for tag, a in page.elements if tag == "img"}
    for (name, depth), plane in planes.items():
        content = base64.b64decode(shown[f"{METHOD_TITLES[name]} at {depth:g} mm"].split(";base64,")[1])
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(picture, grey_levels(plane, white))


def test_page_shows_digests_brightness_and_errors(page: _Page, original: Path) -> None:
    record = json.loads((original / "pmlem-osl" / "reconstruction.json").read_text())
    for digest in record["inputs"].values():
        assert digest in page.words
    overview = json.loads((original / "overview.json").read_text())
    for figure in (overview["brightness"]["snr"], overview["brightness"]["photons_from_moments"]):
        assert f"{figure:.3g}" in page.words
    for plane in json.loads((original / "metrics.json").read_text())["planes"]:
        assert f"{plane['mse_bright']:.4f}" in page.words
    assert "<planes & more>: planes at 3 depths, 500 to 700 mm" in page.words


def test_drawing_again_gives_same_page(planes: Path, text: str, done: Command) -> None:
    (planes / "report.html").unlink()
    ended = done("report", planes)
    assert ended.stdout == f"{planes / 'report.html'}\n"
    assert (planes / "report.html").read_text() == text


def test_results_in_folders_are_shown_together(planes: Path, tmp_path: Path, done: Command) -> None:
    (planes / "report.html").unlink()
    shutil.copytree(planes, tmp_path / "both" / "left")
    shutil.copytree(planes, tmp_path / "both" / "right")
    done("report", tmp_path / "both")
    alternatives = _Page((tmp_path / "both" / "report.html").read_text()).attributes("img", "alt")
    for where in ("left", "right"):
        for title in METHOD_TITLES.values():
            assert f"{where} set: {title} at 600 mm" in alternatives


@pytest.mark.parametrize("kept", [False, True])
def test_titles_say_whether_occlusion_was_kept(kept: bool, planes: Path, done: Command) -> None:
    made = {"method": "occlusion", "occlusion": kept} | ({} if kept else {"occlusion_left_out": "it is no better"})
    (planes / "pmlem-osl").rename(planes / "occlusion")
    for path in (planes / "occlusion" / "reconstruction.json", planes / "metrics.json"):
        content = json.loads(path.read_text())
        content["planes"] = [one | made if one["method"] == "pmlem-osl" else one for one in content["planes"]]
        write_by_hand(path, content)
    done("report", planes)
    page = _Page((planes / "report.html").read_text())
    title = "PMLEM, all planes together" + (", with occlusion" if kept else " (occlusion left out)")
    assert f"The planes below are by {title}." in page.words
    assert f"{title} at 600 mm" in page.attributes("img", "alt")
    assert page.words.count(title) >= 1 + 1 + 2 + 1  # the lead, the slider, errors of two planes, provenance
    assert ("with occlusion" in page.words) == kept
    assert ("left out: it is no better." in page.words) == (not kept)
    assert "--joint" not in page.words


# What a report has always needed of each kind of result; earlier versions did not write all the other keys.
NEEDED = {
    "reconstruction.json": {"planes", "options", "versions", "inputs", "wall_time_s"},
    "overview.json": {"set", "views", "size_px", "exposure_s", "read_noise_e", "brightness"},
    "metrics.json": {"planes"},
}
NEEDED_OF_PLANES = {
    "reconstruction.json": {
        *("file", "depth_mm", "method", "channel", "pitch_mm", "penalty_weight", "penalty_weight_chosen"),
        *("passes", "flux_e", "certificate"),
    },
    "metrics.json": {"depth_mm", "object", "method", "poses", "mse_bright", "mse_texture", "psnr_db"},
}


def _only(record: dict[str, Any], keys: set[str]) -> dict[str, Any]:
    return {key: value for key, value in record.items() if key in keys}


def test_results_with_fewest_keys_are_shown(planes: Path, done: Command) -> None:
    for name, keys in NEEDED.items():
        for path in planes.rglob(name):
            record = _only(json.loads(path.read_bytes()), keys)
            if name in NEEDED_OF_PLANES:
                record["planes"] = [_only(plane, NEEDED_OF_PLANES[name]) for plane in record["planes"]]
            if "options" in record:
                record["options"] = {"method": record["planes"][0]["method"]}
            write_by_hand(path, record)
    done("report", planes)
    text = (planes / "report.html").read_text()
    assert "grey scale: black" not in text
    assert '<td class="number">–</td>' in text


@pytest.mark.parametrize(
    ("name", "change", "failure"),
    [
        ("backprojection/reconstruction.json", lambda record: record.pop("planes"), "BadValue"),
        ("backprojection/reconstruction.json", lambda record: record.update(planes=[]), "BadValue"),
        ("backprojection/reconstruction.json", lambda record: record["planes"][0].update(depth_mm="far"), "BadValue"),
        ("backprojection/reconstruction.json", lambda record: record["planes"][0].update(file="a.tiff"), "MissingFile"),
        ("overview.json", lambda record: record.pop("brightness"), "BadValue"),
        ("metrics.json", lambda record: record.update(planes=[{"depth_mm": 500.0}]), "BadValue"),
    ],
)
def test_damaged_result_is_named(
    name: str, change: Callable[[dict[str, Any]], object], failure: str, planes: Path, faintfield: Command
) -> None:
    path = planes / name
    record = json.loads(path.read_text())
    change(record)
    write_by_hand(path, record)
    before = (planes / "report.html").read_bytes()
    ended = faintfield("report", planes)
    assert ended.returncode == 1
    assert ended.stderr.startswith(f"faintfield: {failure}: ")
    assert path.parent.name in ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    assert (planes / "report.html").read_bytes() == before


def test_plane_that_is_missing_or_damaged_is_named(planes: Path, faintfield: Command) -> None:
    path = planes / "pmlem-osl" / "plane_00600.0.tiff"
    path.write_bytes(path.read_bytes()[:1000])
    ended = faintfield("report", planes)
    assert (ended.returncode, "UnreadableImage" in ended.stderr, str(path) in ended.stderr) == (1, True, True)
    path.unlink()
    ended = faintfield("report", planes)
    assert (ended.returncode, "MissingFile" in ended.stderr, str(path) in ended.stderr) == (1, True, True)
    assert "reconstruct again" in ended.stderr


def test_folder_without_results_is_refused(tmp_path: Path, faintfield: Command) -> None:
    ended = faintfield("report", tmp_path)
    assert ended.returncode == 1
    assert "MissingFile" in ended.stderr
    assert not list(tmp_path.iterdir())
