"""The report in a real headless browser, from disk: no complaint, working sliders; on a phone, printed, in the dark."""

import base64
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.pipelines.cli import run
from tests.end_to_end.browser import CHROMIUM, Tab, open_browser
from tests.patience import HANG_S

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here: the page is not tried in one")

METHODS = ("back-projection", "PMLEM (one-step-late, TV)")
DEPTHS = ("500 mm", "600 mm", "700 mm")


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    small = ["--size-px", "96", "72", "--rows", "3", "--columns", "3"]
    assert run(["simulate", str(folder / "set"), *small]) == 0
    words = ["--method", "backprojection", "--method", "pmlem-osl", "--passes", "3", "--out", str(folder / "out")]
    assert run(["reconstruct", str(folder / "set"), "--sweep-mm", "500:700:3", *words]) == 0
    return folder / "out" / "report.html"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with open_browser(tmp_path_factory.mktemp("browser")) as tab:
        yield tab


@pytest.fixture
def page(browser: Tab, report: Path) -> Tab:
    browser.call("Emulation.setEmulatedMedia", media="", features=[{"name": "prefers-color-scheme", "value": "light"}])
    _resize(browser, 1200, 900)
    browser.open("about:blank")
    browser.open(report.as_uri())
    browser.wait_until("document.readyState === 'complete' && document.getElementById('strip').children.length === 3")
    browser.evaluate("localStorage.clear()")
    return browser


def _resize(tab: Tab, width: int, height: int) -> None:
    tab.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 500)


def _move(tab: Tab, slider: str, value: int) -> None:
    """Do what a hand on the slider does."""
    tab.evaluate(
        f"(() => {{ const one = document.getElementById('{slider}'); one.value = {value}; "
        "one.dispatchEvent(new Event('input', {bubbles: true})); })()"
    )


def _caption(tab: Tab) -> str:
    return str(tab.evaluate("document.getElementById('at').value"))


def _screen(tab: Tab) -> NDArray[Any]:
    picture = base64.b64decode(tab.call("Page.captureScreenshot", format="png")["data"])
    decoded = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded)


def test_it_opens_without_a_complaint(page: Tab) -> None:
    assert page.complaints == []
    assert page.evaluate("[...document.images].every(one => one.complete && one.naturalWidth > 0)")


def test_sliders_show_every_depth_of_every_method(page: Tab) -> None:
    shown = set()
    for method, title in enumerate(METHODS):
        _move(page, "column", method)
        for depth, words in enumerate(DEPTHS):
            _move(page, "depth", depth)
            assert _caption(page) == f"{title}, {words}"
            assert page.evaluate("document.getElementById('depth').getAttribute('aria-valuetext')") == words
            assert page.evaluate("document.getElementById('column').getAttribute('aria-valuetext')") == title
            shown.add(page.evaluate("document.getElementById('plane').src"))
            page.wait_until("document.getElementById('plane').complete")
    assert len(shown) == len(METHODS) * len(DEPTHS)
    assert page.complaints == []


def test_sliders_obey_the_keyboard(page: Tab) -> None:
    _move(page, "depth", 0)
    page.evaluate("document.getElementById('depth').focus()")
    for kind in ("rawKeyDown", "keyUp"):
        page.call("Input.dispatchKeyEvent", type=kind, key="ArrowRight", code="ArrowRight", windowsVirtualKeyCode=39)
    page.wait_until("document.getElementById('at').value.includes('600 mm')")


def test_a_picture_of_the_strip_leads_to_its_depth(page: Tab) -> None:
    page.evaluate("document.getElementById('strip').children[2].click()")
    assert "700 mm" in _caption(page)
    assert page.evaluate("document.getElementById('depth').value") == "2"
    current = "[...document.getElementById('strip').children].map(one => one.getAttribute('aria-current'))"
    assert page.evaluate(current) == ["false", "false", "true"]


@pytest.mark.parametrize("times", [1, 2, 4])
def test_zoom_is_by_whole_numbers_and_unsmoothed(times: int, page: Tab) -> None:
    _move(page, "zoom", times)
    width, rendering = page.evaluate(
        "(() => { const one = document.getElementById('plane'); "
        "return [one.getBoundingClientRect().width / one.naturalWidth, getComputedStyle(one).imageRendering]; })()"
    )
    assert (width, rendering) == (times, "pixelated")


def test_every_control_has_a_name(page: Tab) -> None:
    nameless = page.evaluate(
        "[...document.querySelectorAll('input, select, button')]"
        ".filter(one => !(one.labels?.length || one.textContent.trim() || one.ariaLabel)).length"
    )
    assert nameless == 0
    assert page.evaluate("[...document.images].every(one => one.alt || one.closest('button'))")


@pytest.mark.parametrize("width", [390, 768, 1200])
def test_nothing_hangs_over_the_edge(width: int, page: Tab) -> None:
    _resize(page, width, 844)
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_on_a_phone_drawings_fit_and_what_scrolls_fades_where_there_is_more(page: Tab) -> None:
    _resize(page, 390, 844)
    assert page.evaluate(
        "[...document.querySelectorAll('svg')].map(one => one.getBoundingClientRect().right <= 390)"
    ) == [True]
    table = "document.querySelector('#errors .wide')"
    page.wait_until(f"{table}.className === 'wide after'")
    mask = f"getComputedStyle({table}).maskImage"
    assert "rgba(0, 0, 0, 0)" in page.evaluate(mask)
    page.evaluate(f"{table}.scrollLeft = 10000")
    page.wait_until(f"{table}.className === 'wide before'")
    _resize(page, 1200, 844)
    page.wait_until(f"{table}.className === 'wide'")
    assert "rgba(0, 0, 0, 0)" not in page.evaluate(mask)


def test_in_print_everything_is_there_but_the_controls(page: Tab) -> None:
    _move(page, "depth", 1)
    page.call("Emulation.setEmulatedMedia", media="print", features=[{"name": "prefers-color-scheme", "value": "dark"}])
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    seen = "(one => Boolean(one.offsetParent))"
    assert not page.evaluate(f"[...document.querySelectorAll('input, select')].some({seen})")
    assert page.evaluate("[...document.querySelectorAll('details')].every(one => one.open)")
    assert "600 mm" in page.evaluate("document.getElementById('at').innerText")
    assert page.evaluate("document.getElementById('strip').innerText").split("\n") == list(DEPTHS)
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"


def test_it_prints_with_the_plane_that_it_opens_with(report: Path, tmp_path: Path) -> None:
    assert CHROMIUM is not None
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    command = [CHROMIUM, *options, f"--print-to-pdf={tmp_path / 'report.pdf'}", report.as_uri()]
    subprocess.run(command, check=True, capture_output=True, timeout=HANG_S)
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")
    reader = shutil.which("pdftotext")
    if reader is not None:
        words = subprocess.run(
            [reader, tmp_path / "report.pdf", "-"], check=True, capture_output=True, text=True
        ).stdout
        assert re.search(r"PMLEM \(one-step-late, TV\), \d00 mm; white is", words.replace("\n", " "))
        assert "opencv-contrib" in words  # of the part that is folded on screen
        assert "Zoom" not in words


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_follows_the_system(scheme: str, page: Tab) -> None:
    page.call("Emulation.setEmulatedMedia", media="", features=[{"name": "prefers-color-scheme", "value": scheme}])
    page.wait_until(f"document.documentElement.className === '{scheme}'")
    assert (np.median(_screen(page)) < 60) == (scheme == "dark")


def test_in_the_dark_room_it_is_red_and_dim_all_over(page: Tab) -> None:
    page.evaluate(
        "(() => { const one = document.getElementById('screen'); one.value = 'red'; "
        "one.dispatchEvent(new Event('input')); })()"
    )
    for place in ("light", "planes", "depths"):
        page.evaluate(f"document.getElementById('{place}').scrollIntoView()")
        blue, green, red = cv2.split(_screen(page))
        assert max(int(blue.max()), int(green.max())) <= 5
        assert 60 < red.max() <= 210
    page.reload()
    page.wait_until("document.documentElement.className === 'red'")  # it is remembered
    page.evaluate("localStorage.clear()")


def test_the_pages_own_numbers_are_those_of_the_files(page: Tab, report: Path) -> None:
    white = page.evaluate("document.querySelector('.bar').innerText")
    assert "e⁻ per pixel" in white
    overview = json.loads((report.parent / "overview.json").read_text())
    assert f"{overview['grey_scale_dn'][1]:.0f} DN" in page.text()
