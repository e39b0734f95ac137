"""One browser and one small report for all tests of pages."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from faintfield.pipelines.cli import run
from tests.end_to_end.browser import CHROMIUM, Tab, open_browser


@pytest.fixture(scope="session")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here: the page is not tried in a browser")
    with open_browser(tmp_path_factory.mktemp("browser")) as tab:
        yield tab


@pytest.fixture
def browser(tab: Tab) -> Tab:
    """An empty page on a wide screen in the light scheme, and no complaint of pages whose capture has ended."""
    tab.open("about:blank")
    tab.wait_until("location.href === 'about:blank' && document.readyState === 'complete'")
    tab.complaints.clear()
    tab.call("Emulation.setEmulatedMedia", media="", features=[{"name": "prefers-color-scheme", "value": "light"}])
    tab.resize(1200)
    return tab


@pytest.fixture(scope="session")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a small sweep by two methods, beside its files."""
    folder = tmp_path_factory.mktemp("report")
    assert run(["simulate", str(folder / "set"), "--size-px", "96", "72", "--rows", "3", "--columns", "3"]) == 0
    words = ["--method", "backprojection", "--method", "pmlem-osl", "--passes", "3", "--out", str(folder / "out")]
    assert run(["reconstruct", str(folder / "set"), "--sweep-mm", "500:700:3", *words]) == 0
    return folder / "out" / "report.html"


@pytest.fixture
def page(browser: Tab, report: Path) -> Iterator[Tab]:
    """The report, scrolled to its viewer, with no choice remembered."""
    browser.open(report.as_uri())
    browser.wait_until("document.querySelector('.v-stage').dataset.ready === 'all'")
    browser.wait_until("document.readyState === 'complete' && document.getElementById('strip').children.length === 3")
    browser.evaluate("localStorage.clear()")
    browser.evaluate("document.querySelector('.v-stage').scrollIntoView()")
    browser.draw()
    yield browser
    assert browser.complaints == []
