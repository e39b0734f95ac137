"""The report in a real headless browser, from disk: no complaint, working sliders; on a phone, printed, in the dark."""

import base64
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.end_to_end.browser import Tab

METHODS = ("back-projection", "PMLEM (one-step-late, TV)")
DEPTHS = ("500 mm", "600 mm", "700 mm")


def _caption(tab: Tab) -> str:
    return str(tab.evaluate("document.getElementById('at').value"))


def _screen(tab: Tab) -> NDArray[Any]:
    picture = base64.b64decode(tab.call("Page.captureScreenshot", format="png")["data"])
    decoded = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded)


def test_sliders_show_all_depths_and_methods(page: Tab) -> None:
    shown = set()
    for method, title in enumerate(METHODS):
        page.set_slider("column", method)
        for depth, words in enumerate(DEPTHS):
            page.set_slider("depth", depth)
            assert _caption(page) == f"{title}, {words}"
            assert page.evaluate("document.getElementById('depth').getAttribute('aria-valuetext')") == words
            assert page.evaluate("document.getElementById('column').getAttribute('aria-valuetext')") == title
            shown.add(page.evaluate("document.getElementById('plane').src"))
            page.wait_until("document.getElementById('plane').complete")
    assert len(shown) == len(METHODS) * len(DEPTHS)
    assert page.complaints == []


def test_picture_of_strip_leads_to_depth(page: Tab) -> None:
    page.evaluate("document.getElementById('strip').children[2].click()")
    assert "700 mm" in _caption(page)
    assert page.evaluate("document.getElementById('depth').value") == "2"
    current = "[...document.getElementById('strip').children].map(one => one.getAttribute('aria-current'))"
    assert page.evaluate(current) == ["false", "false", "true"]


def test_phone_shows_where_tables_scroll(page: Tab) -> None:
    page.resize(390, 844)
    assert page.evaluate(
        "[...document.querySelectorAll('svg')].map(one => one.getBoundingClientRect().right <= 390)"
    ) == [True]
    table = "document.querySelector('#errors .wide')"
    page.wait_until(f"{table}.className === 'wide after'")
    mask = f"getComputedStyle({table}).maskImage"
    assert "rgba(0, 0, 0, 0)" in page.evaluate(mask)
    page.evaluate(f"{table}.scrollLeft = 10000")
    page.wait_until(f"{table}.className === 'wide before'")
    page.resize(1200, 844)
    page.wait_until(f"{table}.className === 'wide'")
    assert "rgba(0, 0, 0, 0)" not in page.evaluate(mask)


def test_print_shows_everything_but_controls(page: Tab) -> None:
    page.set_slider("depth", 1)
    page.call("Emulation.setEmulatedMedia", media="print", features=[{"name": "prefers-color-scheme", "value": "dark"}])
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    seen = "(one => Boolean(one.offsetParent))"
    assert not page.evaluate(f"[...document.querySelectorAll('input, select')].some({seen})")
    assert page.evaluate("[...document.querySelectorAll('details')].every(one => one.open)")
    assert "600 mm" in page.evaluate("document.getElementById('at').innerText")
    assert page.evaluate("document.getElementById('strip').innerText").split("\n") == list(DEPTHS)
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"


def test_dark_room_screen_is_red_and_dim(page: Tab) -> None:
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


def test_numbers_of_page_are_those_of_files(page: Tab, report: Path) -> None:
    white = page.evaluate("document.querySelector('.bar').innerText")
    assert "e⁻ per pixel" in white
    overview = json.loads((report.parent / "overview.json").read_text())
    assert f"{overview['grey_scale_dn'][1]:.0f} DN" in page.text()


@pytest.mark.parametrize("times", [1, 4])
def test_zoom_is_by_whole_numbers_and_unsmoothed(times: int, page: Tab) -> None:
    page.set_slider("zoom", times)
    width, rendering = page.evaluate(
        "(one => [one.getBoundingClientRect().width / one.naturalWidth, getComputedStyle(one).imageRendering])"
        "(document.getElementById('plane'))"
    )
    assert (width, rendering) == (times, "pixelated")


def test_controls_and_pictures_have_names(page: Tab) -> None:
    nameless = page.evaluate(
        "[...document.querySelectorAll('input, select, button, #viewer [tabindex]')]"
        ".filter(one => !(one.labels?.length || one.textContent.trim() || one.ariaLabel)).length"
    )
    assert nameless == 0
    assert page.evaluate("[...document.images].every(one => one.alt || one.closest('button'))")
    assert page.evaluate("document.querySelectorAll('#viewer [tabindex]:not([tabindex=\"0\"])').length") == 0


@pytest.mark.parametrize("width", [390, 1400])
def test_page_and_viewer_fit_the_screen(width: int, page: Tab) -> None:
    page.resize(width)
    page.draw()
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    left, right = page.evaluate(
        "(box => [box.left, box.right])(document.querySelector('.v-stage').getBoundingClientRect())"
    )
    assert left >= 0
    assert right <= width


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_page_follows_scheme_with_enough_contrast(scheme: str, page: Tab) -> None:
    page.call("Emulation.setEmulatedMedia", media="", features=[{"name": "prefers-color-scheme", "value": scheme}])
    page.wait_until(f"document.documentElement.className === '{scheme}'")
    assert (np.median(_screen(page)) < 60) == (scheme == "dark")
    colours = page.evaluate("""['button', 'select', 'label', 'output', 'legend']
        .flatMap(tag => [...document.querySelectorAll('#viewer ' + tag)])
        .filter(it => it.textContent && !it.disabled).map(it => {
          let behind = it;
          while (getComputedStyle(behind).backgroundColor === 'rgba(0, 0, 0, 0)') behind = behind.parentElement;
          return [getComputedStyle(it).color, getComputedStyle(behind).backgroundColor];
        })""")
    assert colours
    for pair in colours:
        light = sorted(_luminance(colour) for colour in pair)
        assert (light[1] + 0.05) / (light[0] + 0.05) >= 4.5, pair


def _luminance(colour: str) -> float:
    """Return the relative luminance of an opaque colour by WCAG 2."""
    values = np.array([float(word) for word in re.findall(r"[\d.]+", colour)[:3]]) / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])
