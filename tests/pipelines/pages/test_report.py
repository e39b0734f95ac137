"""`report`: one page of planes or surfaces that needs nothing but itself."""

import base64
import json
import re
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from faintfield.pipelines.formats.image_files import grey_levels, white_level
from faintfield.pipelines.pages import report_surface
from faintfield.pipelines.pages.page import figure, snr_text
from tests.pipelines.by_hand import write_by_hand
from tests.pipelines.conftest import Command, assert_refused, run_undrawn
from tests.pipelines.forms import read_record
from tests.pipelines.surfaces import write_example

METHOD_TITLES = {"backprojection": "back-projection", "pmlem-osl": "PMLEM (one-step-late, TV)"}
VOID = {"meta", "img", "input", "br", "hr", "link"}


class _Page(HTMLParser):
    """Content of a page: its elements, its words, and elements that are not closed in turn."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text = text
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

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID and (not self.open or self.open.pop() != tag):
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
    run_undrawn("reconstruct", simulated_scene, "--out", out, "--sweep-mm", "500:700:3", *methods, "--passes", 3)
    return out


@pytest.fixture
def planes(original: Path, tmp_path: Path) -> Path:
    """A copy of the results that a test may change."""
    return Path(shutil.copytree(original, tmp_path / original.name))


@pytest.fixture(scope="module")
def page(original: Path) -> _Page:
    return _Page((original / "report.html").read_text())


def test_page_is_well_formed_and_self_contained(page: _Page) -> None:
    text = page.text
    assert text.startswith("<!doctype html>")
    assert page.mistakes == []
    assert page.open == []
    (policy,) = [a["content"] for tag, a in page.elements if tag == "meta" and "http-equiv" in a]
    assert policy is not None
    assert policy.startswith("default-src 'none'; img-src data:;")
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
    sources = {*page.attributes("img", "src"), *re.findall(r'"src": "(data:[^"]+)"', text)}
    assert len(sources) >= 3 + 3 * 2 + 3 * 2  # the set, the planes side by side, the slider
    for source in sources:
        kind, content = source.split(";base64,")
        assert kind in ("data:image/png", "data:image/jpeg", "data:image/webp")
        assert cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_UNCHANGED) is not None


def test_planes_share_grey_scale_of_least_noisy_method(page: _Page, original: Path) -> None:
    places = product(METHOD_TITLES, (500.0, 600.0, 700.0))
    planes = {(name, z): tifffile.imread(original / name / f"plane_{z:07.1f}.tiff") for name, z in places}
    white = min(max(white_level(planes[name, z]) for z in (500.0, 600.0, 700.0)) for name in METHOD_TITLES)
    assert f"{white:.3g} e⁻ per pixel" in page.words
    shown = {a["alt"]: a["src"] or "" for tag, a in page.elements if tag == "img"}
    for (name, depth), plane in planes.items():
        content = base64.b64decode(shown[f"{METHOD_TITLES[name]} at {depth:g} mm"].split(";base64,")[1])
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(picture, grey_levels(plane, white))


def test_page_shows_digests_brightness_and_errors(page: _Page, original: Path) -> None:
    for digest in read_record(original / "pmlem-osl")["inputs"].values():
        assert digest in page.words
    light = read_record(original, "overview.json")["brightness"]
    for number in (light["snr"], light["photons_from_moments"]):
        assert f"{number:.3g}" in page.words
    for plane in read_record(original, "metrics.json")["planes"]:
        assert f"{plane['mse_bright']:.4f}" in page.words
    assert "<planes & more>: planes at 3 depths, 500 to 700 mm" in page.words


def test_drawn_again_alone_and_together(planes: Path, page: _Page, tmp_path: Path, done: Command) -> None:
    (planes / "report.html").unlink()
    assert done("report", planes).stdout == f"{planes / 'report.html'}\n"
    assert (planes / "report.html").read_text() == page.text
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
        content["planes"] = [plane | (made if plane["method"] == "pmlem-osl" else {}) for plane in content["planes"]]
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


def test_errors_follow_prior_of_each_plane(planes: Path, done: Command) -> None:
    """Errors of a prior lead the page beside those at the depth where it is left out."""
    priors: dict[float, dict[str, str | float]] = {
        500.0: {"name": "tv", "left_out": "the views contradict it"},
        700.0: {"name": "auto", "moved_sigma": 0.5},
    }
    made = read_record(planes / "pmlem-osl")
    made["planes"] = [plane | {"prior": priors.get(plane["depth_mm"], priors[700.0])} for plane in made["planes"]]
    write_by_hand(planes / "pmlem-osl" / "reconstruction.json", made)
    metrics = read_record(planes, "metrics.json")
    rows = [row for row in metrics["planes"] if row["method"] == "pmlem-osl"]
    for row in rows:
        row["prior"] = priors[row["depth_mm"]]["name"]
    write_by_hand(planes / "metrics.json", metrics)
    done("report", planes)
    words = _Page((planes / "report.html").read_text()).words
    assert len(rows) == 2
    shown = ", ".join(figure(row["mse_texture"]) for row in rows)
    assert f"Mean square error{shown}against the object" in words


# What a report has always needed of results and their planes; earlier versions did not write all the other keys.
NEEDED = """
planes options versions inputs wall_time_s set views size_px exposure_s read_noise_e brightness file depth_mm method
channel pitch_mm penalty_weight penalty_weight_chosen passes flux_e certificate object poses mse_bright mse_texture
psnr_db
""".split()


def test_page_states_tone_curve_of_views(planes: Path, done: Command) -> None:
    write_by_hand(planes / "overview.json", read_record(planes, "overview.json") | {"tone": "srgb"})
    done("report", planes)
    words = _Page((planes / "report.html").read_text()).words
    assert "Views and noise reference have one grey scale with the tone curve of sRGB" in words


def test_results_with_fewest_keys_are_shown(planes: Path, done: Command) -> None:
    for path in [*planes.rglob("reconstruction.json"), planes / "overview.json", planes / "metrics.json"]:
        record = {key: value for key, value in json.loads(path.read_bytes()).items() if key in NEEDED}
        if "planes" in record:
            record["planes"] = [{key: plane[key] for key in NEEDED if key in plane} for plane in record["planes"]]
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
    assert_refused(ended, failure, path.parent.name)
    assert len(ended.stderr.splitlines()) == 1
    assert (planes / "report.html").read_bytes() == before


def test_missing_or_damaged_planes_are_named(planes: Path, tmp_path: Path, faintfield: Command) -> None:
    path = planes / "pmlem-osl" / "plane_00600.0.tiff"
    path.write_bytes(path.read_bytes()[:1000])
    assert_refused(faintfield("report", planes), "UnreadableImage", str(path))
    path.unlink()
    assert_refused(faintfield("report", planes), "MissingFile", str(path), "reconstruct again")
    (tmp_path / "empty").mkdir()
    assert_refused(faintfield("report", tmp_path / "empty"), "MissingFile")
    assert not list((tmp_path / "empty").iterdir())


@pytest.fixture
def surface(written_surface: Path, tmp_path: Path) -> Path:
    """A copy of the surface in mm that a test may change."""
    return Path(shutil.copytree(written_surface, tmp_path / "<toys & more>"))


def _section(folder: Path, done: Command) -> str:
    """Return the part of the page that shows the surface."""
    done("report", folder)
    page = (folder / "report.html").read_text()
    return page[page.index('<section id="surface">') :].partition("</section>")[0]


def _words(html: str) -> str:
    return " ".join(re.sub(r"<[^>]*>", " ", html).split())


def test_folder_with_surface_alone_has_report(surface: Path, done: Command) -> None:
    message = _words(_section(surface, done))
    assert "Depth searched 400 to 900 mm found in the views; 64 depths compared in bins of 2 × 2 pixels" in message
    for words in ("Known 98 %", "3 of the views", "surface 1.012", "planes 1.340", "predicts them best"):
        assert words in message
    page = (surface / "report.html").read_text()
    assert "<title>faintfield · &lt;toys &amp; more&gt;: a surface</title>" in page
    assert "What all views show, sharp everywhere." in page
    first = _words(page.partition('<dl class="facts">')[2].partition("</dl>")[0])
    assert re.match(r"Sure depths 12 % .* Deviance; 1 is perfect 1\.01 .* SNR of a view – not recorded", first)
    assert 'class="banner"' not in page
    assert "The planes below" not in page
    assert "within 0.40 % of the optimum" in page  # in the provenance
    assert "poisson-gaussian" in page


def test_pictures_are_those_of_folder(surface: Path, done: Command) -> None:
    section = _section(surface, done)
    film, *shown = [base64.b64decode(found) for found in re.findall(r'<img src="data:[^,]*,([^"]*)"', section)]
    assert film == (surface / "parallax.webp").read_bytes()
    names = ("depth_mm.png", "depth_confidence.png", "visibility.png")
    for name, content in zip(names, shown, strict=True):
        assert _difference((surface / name).read_bytes(), content) < 8  # noise packs worst
    still = re.search(
        r'<source media="\(prefers-reduced-motion: reduce\), print" srcset="data:image/webp;base64,([^"]*)">', section
    )
    assert still is not None
    assert _difference((surface / "picture.png").read_bytes(), base64.b64decode(still[1])) < 3
    above = (surface / "report.html").read_text().partition('<section id="surface">')[0]
    assert still[1] in above  # the picture leads the page


def _difference(*contents: bytes) -> float:
    """Return the mean difference of two pictures in grey levels; pages have them with losses."""
    first, second = (cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) for content in contents)
    assert first is not None
    assert second is not None
    return float(np.mean(cv2.absdiff(first, second)))


def test_viewer_shows_surface_with_its_uncertainty(surface: Path, done: Command) -> None:
    done("report", surface)
    data = (surface / "report.html").read_text().partition('id="viewer-data">')[2].partition("</script>")[0]
    viewer = json.loads(data)
    pictures = {picture["label"]: picture for picture in viewer["pictures"]}
    depth, picture = pictures["depth"], pictures["picture"]
    assert viewer["pictures"][viewer["first"][1]] == picture
    assert viewer["pictures"][picture["sigma"]]["label"] == "σ of the light"
    assert viewer["pictures"][depth["sigma"]]["label"] == "σ of the depth"
    assert viewer["pictures"][depth["confidence"]]["label"] == "probability of the depth"
    assert (depth["unit"], depth["sure_above"]) == ("mm", 0.9)
    ball_and_wall = {"black": 450.0, "white": 800.0}  # the wall is rather right than wrong
    assert viewer["scales"]["depth"] == ball_and_wall | {"name": "depth", "colours": True}


def test_disparities_are_no_lengths(tmp_path: Path, done: Command) -> None:
    write_example(tmp_path, unit="px", colours=3)
    message = _words(_section(tmp_path, done))
    assert "Disparity searched −14.0 to −6.00 px" in message
    assert "Disparity, px." in message
    assert not re.search(r"\bmm\b|\bdepth, |point cloud", message)


def test_what_is_not_there_is_not_shown(surface: Path, done: Command) -> None:
    record = read_record(surface, "surface.json")
    record["surface"] |= {"held_out": None, "film": None, "points": None, "median": None, "range_found": False}
    write_by_hand(surface / "surface.json", record)
    (surface / "visibility.png").unlink()
    section = _section(surface, done)
    message = _words(section)
    assert "as asked for" in message
    assert "Median depth –" in message
    for absent in ("left out", "Moving.", "Seen by.", "point cloud", "<source"):
        assert absent not in section


@pytest.mark.parametrize(
    ("deviance", "neighbours", "says"),
    [
        (2045.3, 3000.0, "misses 68% of what changes from view to view"),
        (0.9, 0.8, "better by their neighbours"),
        (2045.3, None, "45 times their noise, and have no neighbours"),
    ],
)
def test_unexplained_surface_says_so_first(
    deviance: float, neighbours: float | None, says: str, surface: Path, done: Command
) -> None:
    record = read_record(surface, "surface.json")
    record["surface"]["held_out"] |= {"surface": deviance, "planes": 1.01 * deviance, "neighbours": neighbours}
    record["surface"]["share_of_sure"] = [0.2, 0.2]
    write_by_hand(surface / "surface.json", record)
    section = _section(surface, done)
    page = (surface / "report.html").read_text()
    banner, figures = page.index('<p class="banner">'), page.index('<dl class="facts">')
    assert says in page[banner:figures]
    assert "sharp everywhere" not in page
    assert "explain what other cameras see" not in section
    assert "fits it" not in page


@pytest.mark.parametrize(("deviance", "neighbours"), [(1.16, 1.31), (14.8, 318), (968.8, 2140)])
def test_bright_light_alone_warns_of_nothing(deviance: float, neighbours: float, surface: Path, done: Command) -> None:
    """In bright light the error of a right surface is many times the noise, and a small share of the changes."""
    record = read_record(surface, "surface.json")
    record["surface"]["held_out"] |= {"surface": deviance, "planes": 1.3 * deviance, "neighbours": neighbours}
    write_by_hand(surface / "surface.json", record)
    _section(surface, done)
    page = (surface / "report.html").read_text()
    assert 'class="banner"' not in page
    assert f"explains {100 - 100 * (deviance - 1) / (neighbours - 1):.0f} % of what changes" in page


def test_overlarge_picture_is_refused(surface: Path, faintfield: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_surface, "MAX_PREVIEW_BYTES", 1000)
    assert_refused(faintfield("report", surface), "MissingFile")


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.16e7, "1.16 × 10⁷"), (2.5e-5, "2.50 × 10⁻⁵"), (66310.4, "66300"), (-0.5, "−0.500"), (None, "–")],
)
def test_figures_have_digits_and_powers_of_print(value: float | None, text: str) -> None:
    assert figure(value) == text


def test_snr_beyond_noise_has_no_digits() -> None:
    assert (snr_text(1.16e7), snr_text(0.16)) == ("above 1000", "0.160")
