"""The report in a real headless browser, from disk: no complaint, working sliders; on a phone, printed, in the dark."""

import json
import re
from pathlib import Path

import cv2
import numpy as np

from tests.end_to_end.browser import Tab

METHODS = ("back-projection", "PMLEM (one-step-late, TV)")
DEPTHS = ("500 mm", "600 mm", "700 mm")


def _caption(tab: Tab) -> str:
    return str(tab.evaluate("document.getElementById('at').value"))


def test_sliders_and_strip_show_depths_and_methods(page: Tab, report: Path) -> None:
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
    page.evaluate("document.getElementById('strip').children[1].click()")
    assert "600 mm" in _caption(page)
    assert page.evaluate("document.getElementById('depth').value") == "1"
    current = "[...document.getElementById('strip').children].map(one => one.getAttribute('aria-current'))"
    assert page.evaluate(current) == ["false", "true", "false"]
    for times in (1, 4):
        page.set_slider("zoom", times)
        width, rendering = page.evaluate(
            "(one => [one.getBoundingClientRect().width / one.naturalWidth, getComputedStyle(one).imageRendering])"
            "(document.getElementById('plane'))"
        )
        assert (width, rendering) == (times, "pixelated")
    assert "e⁻ per pixel" in page.evaluate("document.querySelector('.bar').innerText")
    overview = json.loads((report.parent / "overview.json").read_text())
    assert f"{overview['grey_scale_dn'][1]:.0f} DN" in page.text()


def test_page_fits_phone_and_wide_screen(page: Tab) -> None:
    table = "document.querySelector('#errors .wide')"
    mask = f"getComputedStyle({table}).maskImage"
    for width, side in ((390, "wide after"), (1400, "wide")):
        page.resize(width)
        page.wait_until(f"{table}.className === '{side}'")
        assert ("rgba(0, 0, 0, 0)" in page.evaluate(mask)) == (width == 390)  # it shows where tables scroll
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        drawings = "[...document.querySelectorAll('svg')].map(one => one.getBoundingClientRect().right)"
        (right,) = page.evaluate(drawings)
        assert right <= width
        left, _, stage_width, _ = page.box(".v-stage")
        assert left >= 0
        assert left + stage_width <= width
    page.resize(390)
    page.evaluate(f"{table}.scrollLeft = 10000")
    page.wait_until(f"{table}.className === 'wide before'")


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
    page.choose("screen", "red")
    for place in ("light", "planes", "depths"):
        page.evaluate(f"document.getElementById('{place}').scrollIntoView()")
        blue, green, red = cv2.split(page.screen())
        assert max(int(blue.max()), int(green.max())) <= 5
        assert 60 < red.max() <= 210
    page.reload()
    page.wait_until("document.documentElement.className === 'red'")  # it is remembered
    page.evaluate("localStorage.clear()")


def test_controls_and_pictures_have_names(page: Tab) -> None:
    nameless = page.evaluate(
        "[...document.querySelectorAll('input, select, button, #viewer [tabindex]')]"
        ".filter(one => !(one.labels?.length || one.textContent.trim() || one.ariaLabel)).length"
    )
    assert nameless == 0
    assert page.evaluate("[...document.images].every(one => one.alt || one.closest('button'))")
    assert page.evaluate("document.querySelectorAll('#viewer [tabindex]:not([tabindex=\"0\"])').length") == 0


def test_page_follows_scheme_with_enough_contrast(page: Tab) -> None:
    for scheme in ("light", "dark"):
        page.call("Emulation.setEmulatedMedia", media="", features=[{"name": "prefers-color-scheme", "value": scheme}])
        page.wait_until(f"document.documentElement.className === '{scheme}'")
        assert (np.median(page.screen()) < 60) == (scheme == "dark")
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
