"""The viewer of a report in a real headless browser, from disk: hands, keys, and whether its numbers are true."""

import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines import pages
from faintfield.pipelines.formats.image_files import grey_levels, light_picture, write_png
from faintfield.pipelines.pages.page import smaller_uri
from faintfield.pipelines.pages.report import write_report
from faintfield.pipelines.pages.viewer_data import pack
from tests.end_to_end.browser import Tab, decoded
from tests.pipelines.by_hand import write_by_hand
from tests.pipelines.forms import GOLDEN
from tests.pipelines.surfaces import SHAPE, write_example

FOLDERS = {"back-projection": "backprojection", "PMLEM (one-step-late, TV)": "pmlem-osl"}
VIRTUAL_KEYS = {"ArrowRight": 39, "ArrowLeft": 37, "ArrowUp": 38, "ArrowDown": 40}


def _state(tab: Tab, name: str) -> float:
    return float(tab.evaluate(f"document.querySelector('.v-stage').dataset.{name}"))


def _mouse(tab: Tab, kind: str, x: float, y: float, **more: Any) -> None:
    tab.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)


def _point(tab: Tab, x: float, y: float) -> None:
    _mouse(tab, "mouseMoved", x, y)
    tab.draw()


def _drag(tab: Tab, start: tuple[float, float], by: tuple[float, float]) -> None:
    held: dict[str, Any] = {"button": "left", "buttons": 1}
    _mouse(tab, "mouseMoved", *start)
    _mouse(tab, "mousePressed", *start, clickCount=1, **held)
    for part in (0.5, 1.0):
        _mouse(tab, "mouseMoved", start[0] + part * by[0], start[1] + part * by[1], **held)
    _mouse(tab, "mouseReleased", start[0] + by[0], start[1] + by[1], button="left")
    tab.draw()


def _press(tab: Tab, *keys: str, shift: bool = False) -> None:
    """Press keys while the pictures have the focus."""
    tab.evaluate("document.querySelector('.v-stage').focus()")
    for key in keys:
        text = {} if len(key) > 1 else {"text": key}
        code = {"windowsVirtualKeyCode": VIRTUAL_KEYS[key]} if key in VIRTUAL_KEYS else {}
        tab.call("Input.dispatchKeyEvent", type="keyDown", key=key, modifiers=8 * shift, **text, **code)
        tab.call("Input.dispatchKeyEvent", type="keyUp", key=key)
    tab.draw()


def _chosen(tab: Tab, side: str) -> str:
    return str(tab.evaluate(f"document.getElementById('v-{side}').selectedOptions[0].text"))


def _click(tab: Tab, words: str) -> None:
    tab.evaluate(
        f"[...document.querySelectorAll('#viewer button')].find(it => it.textContent === {json.dumps(words)}).click()"
    )
    tab.draw()


def _reading(tab: Tab, side: str = "B") -> str:
    return str(tab.evaluate(f"document.getElementById('v-out-{side}').innerText")).replace("−", "-")


def _canvas(tab: Tab) -> NDArray[Any]:
    """Return the pixels of the viewer's canvas (row, column, BGR)."""
    return decoded(tab.evaluate("document.querySelector('.v-stage canvas').toDataURL()").split(",")[1])


def _plane(report: Path, title: str, depth_mm: int) -> tuple[NDArray[np.float32], dict[str, Any]]:
    """Return a plane's numbers as its file has them, and its record."""
    record = json.loads((report.parent / FOLDERS[title] / "reconstruction.json").read_text())
    name = f"plane_{depth_mm:07.1f}.tiff"
    plane_record = next(plane for plane in record["planes"] if plane["file"] == name)
    return tifffile.imread(report.parent / FOLDERS[title] / name), plane_record


def test_numbers_under_cross_are_those_of_files(page: Tab, report: Path) -> None:
    left, top, width, height = page.box(".v-stage")
    size = _state(page, "size")
    rng = np.random.default_rng(1)
    for title, depth_mm in (("back-projection", 500), ("PMLEM (one-step-late, TV)", 700)):
        page.choose("v-B", f"{title}, {depth_mm} mm")
        plane, record = _plane(report, title, depth_mm)
        row, column = (int(rng.integers(1, count - 1)) for count in plane.shape)
        u0, v0 = width / 2 - 0.5 * size, height / 2 - _state(page, "v") * size
        sample_px = size / plane.shape[1]
        _point(page, left + u0 + (column + 0.5) * sample_px, top + v0 + (row + 0.5) * sample_px)
        reading = re.search(
            r"(-?[\d.]+) e⁻ per pixel \(rounded by up to (\S+)\)\s+x (\S+), y (\S+) mm; column (\d+), row (\d+)",
            _reading(page),
        )
        assert reading is not None, _reading(page)
        value, off, x_mm, y_mm = (float(word) for word in reading.groups()[:4])
        assert (int(reading[5]), int(reading[6])) == (column, row)
        assert off < 1e-3
        decimals = len(reading[1].partition(".")[2])
        assert value == pytest.approx(float(plane[row, column]), abs=1.05 * off + 0.5 * 10**-decimals)
        x0_mm, y0_mm = record["origin_mm"]
        assert x_mm == pytest.approx(x0_mm + column * record["pitch_mm"], abs=0.06 * record["pitch_mm"] + 1e-6)
        assert y_mm == pytest.approx(y0_mm + row * record["pitch_mm"], abs=0.06 * record["pitch_mm"] + 1e-6)
    # Both pictures are read at the same place
    columns = [re.search(r"column \d+, row \d+", _reading(page, side)) for side in "AB"]
    assert columns[0] is not None
    assert columns[1] is not None
    assert columns[0][0] == columns[1][0]
    assert " DN" in _reading(page, "A")


def test_keys_and_drag_zoom_and_pan(page: Tab, report: Path) -> None:
    middle = _state(page, "u"), _state(page, "v")
    _press(page, "+", "+")
    assert _state(page, "zoom") == pytest.approx(2.25)
    assert (_state(page, "u"), _state(page, "v")) == pytest.approx(middle)
    size = _state(page, "size")
    left, top, width, height = page.box(".v-stage")
    _drag(page, (left + 0.75 * width, top + 0.5 * height), (-80, 40))
    assert (_state(page, "u") - middle[0]) * size == pytest.approx(80, abs=0.1)
    assert (_state(page, "v") - middle[1]) * size == pytest.approx(-40, abs=0.1)
    _press(page, "ArrowLeft")
    assert (_state(page, "u") - middle[0]) * size == pytest.approx(80 - 60, abs=0.1)
    _press(page, "-")
    assert _state(page, "zoom") == pytest.approx(1.5)
    _press(page, "0")  # all
    assert _state(page, "zoom") == 1
    page.resize(60 + 40)  # narrower than the plane
    _press(page, "1")  # one sample per pixel
    assert _state(page, "size") == pytest.approx(_plane(report, "back-projection", 500)[0].shape[1])


def test_wheel_and_fingers_zoom_at_their_place(page: Tab) -> None:
    left, top, width, height = page.box(".v-stage")
    x, y = left + 0.255 * width, top + 0.5 * height
    _mouse(page, "mouseWheel", x, y, deltaX=0, deltaY=-1)
    page.draw()
    assert _state(page, "zoom") == 1  # before a click the wheel moves the page
    _drag(page, (x, y), (0, 0))
    before = _reading(page)
    _mouse(page, "mouseWheel", x, y, deltaX=0, deltaY=-600)
    page.wait_until("Number(document.querySelector('.v-stage').dataset.zoom) > 2")
    _point(page, x, y)
    assert _reading(page) == before
    _press(page, "0")
    page.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
    try:
        for kind, apart in (("touchStart", 50), ("touchMove", 60), ("touchMove", 80), ("touchMove", 100)):
            points = [{"x": x - apart / 2, "y": y, "id": 0}, {"x": x + apart / 2, "y": y, "id": 1}]
            page.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        page.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        page.wait_until("Math.abs(document.querySelector('.v-stage').dataset.zoom - 2) < 0.05")
    finally:
        page.call("Emulation.setTouchEmulationEnabled", enabled=False)


def test_panels_zoom_and_pan_together(page: Tab) -> None:
    for side in "AB":
        page.choose(f"v-{side}", "PMLEM (one-step-late, TV), 600 mm")
    _click(page, "Side by side")
    _press(page, "+", "+", "ArrowRight", "ArrowDown")
    pixels = _canvas(page)
    half = (pixels.shape[1] - 4) // 2
    a, b = pixels[60:-60, :half], pixels[60:-60, half + 4 : 2 * half + 4]
    np.testing.assert_allclose(a.astype(float), b, atol=2)
    assert a.std() > 10
    _click(page, "All")
    cell = _state(page, "size")
    _press(page, "+")
    assert _state(page, "size") == pytest.approx(1.5 * cell)
    assert _canvas(page)[-60:, : pixels.shape[1] // 3].std() > 10


def test_wipe_moves_by_drag_and_key(page: Tab) -> None:
    left, top, width, height = page.box(".v-stage")
    page.choose("v-A", "back-projection, 500 mm")
    page.set_slider("v-wipe", 0.5)
    page.draw()
    whole = _canvas(page)
    _drag(page, (left + width / 2, top + height / 2), (-0.25 * width, 0))
    assert _state(page, "wipe") == pytest.approx(0.25, abs=0.002)
    moved = _canvas(page)
    middle = slice(int(0.27 * width), int(0.45 * width))
    assert np.abs(whole[60:-60, middle].astype(int) - moved[60:-60, middle]).mean() > 5
    kept = slice(int(0.6 * width), int(0.8 * width))
    # What lies right of both lines is that of B still
    np.testing.assert_array_equal(whole[100:-100, kept], moved[100:-100, kept])
    _press(page, ".", ".", ",")
    assert _state(page, "wipe") == pytest.approx(0.27, abs=0.002)
    assert float(page.evaluate("document.getElementById('v-wipe').value")) == pytest.approx(0.27, abs=0.006)


def test_minimum_and_maximum_set_grey_levels(page: Tab, report: Path) -> None:
    title, depth_mm = "PMLEM (one-step-late, TV)", 700
    page.choose("v-B", f"{title}, {depth_mm} mm")
    plane, _ = _plane(report, title, depth_mm)
    page.set_slider("v-wipe", 0)
    black, white = float(np.quantile(plane, 0.2)), float(np.quantile(plane, 0.9))
    for end, value in (("black", black), ("white", white)):
        page.evaluate(
            f"(box => {{ box.value = {value}; box.dispatchEvent(new Event('change')); }})"
            f"(document.getElementById('v-{end}-number-light'))"
        )
    _press(page, "+", "+", "+", "+", "+", "+")  # samples are squares then
    size, u, v = (_state(page, name) for name in ("size", "u", "v"))
    _, _, width, height = page.box(".v-stage")
    pixels = _canvas(page)
    rng = np.random.default_rng(2)
    compared = 0
    for x, y in zip(rng.uniform(150, width - 150, 40), rng.uniform(100, height - 100, 40), strict=True):
        column, row = ((u + (x - width / 2) / size) * plane.shape[1], (v + (y - height / 2) / size) * plane.shape[1])
        if max(abs(column % 1 - 0.5), abs(row % 1 - 0.5)) < 0.35:  # else at the edge of a sample
            expected = 255 * np.clip((float(plane[int(row), int(column)]) - black) / (white - black), 0, 1)
            assert pixels[int(y), int(x)] == pytest.approx(expected, abs=2)
            compared += 1
    assert compared >= 10


def test_scale_bar_is_true_at_any_zoom(page: Tab, report: Path) -> None:
    lengths = set()
    for depth_mm in (500, 700):
        page.choose("v-A", f"back-projection, {depth_mm} mm")
        plane, record = _plane(report, "back-projection", depth_mm)
        for _ in range(3):
            per_mm = _state(page, "size") / (plane.shape[1] * record["pitch_mm"])
            stated = page.evaluate("document.querySelector('.v-stage').dataset.barA")
            length_mm = float(stated.split(" mm")[0])
            white = (_canvas(page)[-14, 16:] == 255).all(axis=-1)  # 4 px high, 16 px from the left and from below
            assert white[0]
            assert int(np.argmin(white)) == pytest.approx(length_mm * per_mm, abs=1.5)
            lengths.add(length_mm)
            _press(page, "+", "+")
        _press(page, "0")
    assert len(lengths) >= 3


def test_depth_moves_by_slider_key_and_film(page: Tab) -> None:
    page.evaluate("window.due = null; window.setInterval = step => { due = step; return 7; };")
    page.evaluate("window.clearInterval = number => { if (number === 7) due = null; };")
    page.set_slider("v-depth", 0)
    page.draw()
    assert "500 mm" in _chosen(page, "B")
    _press(page, "]")
    assert "600 mm" in _chosen(page, "B")
    _press(page, " ")
    depths = []
    for _ in range(5):
        page.evaluate("due()")
        depths.append(page.evaluate("document.getElementById('v-depth-words').value"))
    assert depths == ["700 mm", "600 mm", "500 mm", "600 mm", "700 mm"]
    assert "700 mm" in _chosen(page, "B")
    _click(page, "■ Stop")
    assert page.evaluate("due") is None
    assert page.evaluate("[...document.querySelectorAll('#viewer button')].some(it => it.textContent === '▶ Film')")
    assert _chosen(page, "A") == "One view, as recorded"
    page.choose("v-A", "back-projection, 700 mm")
    _press(page, "[")
    assert "600 mm" in _chosen(page, "A")
    assert "600 mm" in _chosen(page, "B")


def test_keyboard_reads_sample_aloud(page: Tab, report: Path) -> None:
    page.choose("v-B", "back-projection, 600 mm")
    _press(page, "ArrowRight", "ArrowDown", shift=True)
    status = "document.querySelector('#viewer [role=status]').textContent"
    assert page.evaluate(status) == ""
    _press(page, "r")
    words = page.evaluate(status)
    place = re.search(r"B: back-projection, 600 mm\s+(\S+) e⁻ per pixel .*column (\d+), row (\d+)", words)
    assert place is not None, words
    plane, _ = _plane(report, "back-projection", 600)
    assert float(place[1].replace("−", "-")) == pytest.approx(float(plane[int(place[3]), int(place[2])]), abs=2e-3)


def _page_of(numbers: NDArray[np.float32], folder: Path, **more: object) -> str:
    """Return the address of a page with the viewer alone, of one plane (row, column, colour)."""
    packed = pack(numbers, 1e-3)
    picture = {
        **{"kind": "light", "title": "PMLEM", "label": "500 mm", "place": 0, "unit": "e⁻ per pixel"},
        **{"low": packed.low, "step": packed.step, "bins": 1, "pitch": 0.5, "origin": (-10.0, 20.0)},
        **{"src": smaller_uri(packed.png), **more},
    }
    shown = {
        **{"pictures": [picture], "places": ["500 mm"], "quantity": "depth", "length": "mm"},
        **{"scales": {"light": {"black": 0.0, "white": 2.0, "name": "planes"}}, "binned": False, "first": (0, 0)},
    }
    templates = Path(pages.__path__[0]) / "templates"
    script, style = ((templates / name).read_text() for name in ("viewer.js", "viewer.css"))
    (folder / "alone.html").write_text(
        f'<!doctype html><meta charset="utf-8"><style>{style}</style><section id="viewer"></section>'
        f'<script type="application/json" id="viewer-data">{json.dumps(shown)}</script><script>{script}</script>'
    )
    return (folder / "alone.html").as_uri()


def test_colours_and_missing_samples_are_read(browser: Tab, tmp_path: Path) -> None:
    numbers = np.random.default_rng(3).normal(1.0, 0.5, (30, 40, 3)).astype(np.float32)
    numbers[5, 6] = np.nan
    browser.open(_page_of(numbers, tmp_path))
    browser.wait_until("document.querySelector('.v-stage').dataset.ready === 'all'")
    left, top, width, height = browser.box(".v-stage")
    size, v = _state(browser, "size"), _state(browser, "v")
    for row, column in ((10, 20), (29, 39), (5, 6)):
        x = left + width / 2 + ((column + 0.5) / 40 - 0.5) * size
        _point(browser, x, top + height / 2 + ((row + 0.5) / 40 - v) * size)
        if (row, column) == (5, 6):
            assert _reading(browser).splitlines()[1].strip() == "not known"
        else:
            reading = re.search(r"R (.+), G (.+), B (.+) e⁻ per pixel", _reading(browser))
            assert reading is not None, _reading(browser)
            np.testing.assert_allclose([float(word) for word in reading.groups()], numbers[row, column], atol=1.1e-3)
    assert browser.complaints == []


def test_unknown_samples_have_hatching_of_previews(browser: Tab, tmp_path: Path) -> None:
    unknown = np.full((30, 40, 3), np.nan, np.float32)
    browser.open(_page_of(unknown, tmp_path))
    browser.wait_until("document.querySelector('.v-stage').dataset.ready === 'all'")
    colours = Counter(map(tuple, _canvas(browser)[60:-60].reshape(-1, 3)[:, ::-1].tolist()))
    stripes = {tuple(rgb) for rgb in light_picture(unknown, 1.0).reshape(-1, 3).tolist()}
    assert {colour for colour, _ in colours.most_common(2)} == stripes


def test_saturated_samples_are_named_without_unit(browser: Tab, tmp_path: Path) -> None:
    browser.open(_page_of(np.full((30, 40), np.nan, np.float32), tmp_path, saturated=True))
    browser.wait_until("document.querySelector('.v-stage').dataset.ready === 'all'")
    assert _reading(browser).splitlines()[1].strip() == "saturated"


def test_readout_of_surface_has_uncertainty_and_integers(browser: Tab, tmp_path: Path) -> None:
    shown = write_example(tmp_path)
    overview = json.loads((GOLDEN / "overview_set.json").read_text()) | {"grey_scale_dn": [79.0, 122.0]}
    write_by_hand(tmp_path / "overview.json", overview)
    recorded = np.random.default_rng(1).integers(80, 122, SHAPE)
    write_png(tmp_path / "reference_view.png", grey_levels(recorded.astype(float), 122.0, 79.0))
    browser.open(write_report(tmp_path).as_uri())
    browser.wait_until("document.querySelector('.v-stage').dataset.ready === 'all'")
    browser.choose("v-B", "Surface, depth")
    browser.evaluate("document.querySelector('.v-stage').scrollIntoView()")
    browser.draw()
    left, top, width, height = browser.box(".v-stage")
    size = _state(browser, "size")
    for row, column, confidence in ((40, 50, 0.99), (60, 100, 0.85)):
        across, down = (column + 0.5) / SHAPE[1] - 0.5, (row + 0.5) / SHAPE[1] - _state(browser, "v")
        _point(browser, left + width / 2 + size * across, top + height / 2 + size * down)
        found = re.search(r"([\d.]+) ± ([\d.]+) mm .*?(not sure|sure): .* of ([\d.]+)\)", _reading(browser))
        assert found is not None, _reading(browser)
        depth, sigma = (tifffile.imread(tmp_path / name)[row, column] for name in (shown.depth, shown.depth_sigma))
        assert float(found[1]) == pytest.approx(depth, abs=0.5)
        assert float(found[2]) == pytest.approx(sigma, rel=0.05)
        assert (found[3] == "sure") == (confidence > 0.9)
        assert float(found[4]) == pytest.approx(confidence, abs=0.01)
        assert f"{recorded[row, column]} DN\n" in _reading(browser, "A")
    picture = _canvas(browser)
    assert (picture.max(axis=2) - picture.min(axis=2)).max() > 100  # depths in colours
    assert browser.complaints == []
