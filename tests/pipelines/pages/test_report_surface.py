"""A report of surfaces, with planes beside them or by themselves."""

import base64
import json
import re
import shutil
from pathlib import Path

import pytest

from faintfield.pipelines.pages import report_surface
from tests.pipelines.by_hand import write_by_hand
from tests.pipelines.conftest import Command, drawing_nothing
from tests.pipelines.surfaces import write_example


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A surface in mm and one in px, to be read only."""
    folder = tmp_path_factory.mktemp("surfaces")
    write_example(folder / "in mm")
    with drawing_nothing():
        write_example(folder / "in px", unit="px", colours=3)
    return folder


@pytest.fixture
def surface(written: Path, tmp_path: Path) -> Path:
    """A copy of the surface in mm that a test may change."""
    return Path(shutil.copytree(written / "in mm", tmp_path / "<toys & more>"))


def _section(folder: Path, done: Command) -> str:
    """Return the part of the page that shows the surface."""
    done("report", folder)
    page = (folder / "report.html").read_text()
    return page[page.index('<section id="surface">') :].partition("</section>")[0]


def _words(html: str) -> str:
    return " ".join(re.sub(r"<[^>]*>", " ", html).split())


def _change(folder: Path, **changes: object) -> None:
    """Change the surface of a record as a person would."""
    content = json.loads((folder / "surface.json").read_bytes())
    content["surface"].update(changes)
    write_by_hand(folder / "surface.json", content)


def test_folder_with_surface_alone_has_report(surface: Path, done: Command) -> None:
    message = _words(_section(surface, done))
    assert "Depth searched 400 to 900 mm found in the views; 64 depths compared in bins of 2 × 2 pixels" in message
    assert "Known 98 % of the picture" in message
    assert "Sure 12 % of the picture: the depth is right within 2 % with a probability of at least 90 %" in message
    assert "3 of the views were left out of all rounds but the last" in message
    assert "this surface 1.012" in message
    assert "the same depths on a few planes 1.340" in message
    assert "The surface predicts them best" in message
    page = (surface / "report.html").read_text()
    assert "<title>faintfield · &lt;toys &amp; more&gt;: a surface</title>" in page
    assert "What all views show, sharp everywhere." in page
    assert "The planes below" not in page
    assert "within 0.40 % of the optimum" in page  # in the provenance
    assert "total variation" in page


def test_pictures_are_those_of_folder(surface: Path, done: Command) -> None:
    section = _section(surface, done)
    shown = {base64.b64decode(found) for found in re.findall(r'<img src="data:[^,]*,([^"]*)"', section)}
    names = ("depth_mm.png", "depth_sigma_mm.png", "picture_sigma.png", "depth_confidence.png", "visibility.png")
    assert shown == {(surface / name).read_bytes() for name in (*names, "parallax.webp")}
    assert (
        f'src="data:image/webp;base64,{base64.b64encode((surface / "parallax.webp").read_bytes()).decode()}"' in section
    )
    still = base64.b64encode((surface / "picture.png").read_bytes()).decode()
    assert f'<source media="(prefers-reduced-motion: reduce), print" srcset="data:image/png;base64,{still}">' in section
    above = (surface / "report.html").read_text().partition('<section id="surface">')[0]
    assert still in above  # the picture leads the page


def test_disparities_are_no_lengths(written: Path, tmp_path: Path, done: Command) -> None:
    section = _section(Path(shutil.copytree(written / "in px", tmp_path / "out")), done)
    message = _words(section)
    assert "Disparity searched −14.0 to −6.00 px" in message
    assert "Disparity, px." in message
    assert not re.search(r"\bmm\b|\bdepth, |point cloud", message)


def test_what_is_not_there_is_not_shown(surface: Path, done: Command) -> None:
    _change(surface, held_out=None, film=None, points=None, median=None, range_found=False)
    (surface / "visibility.png").unlink()
    section = _section(surface, done)
    message = _words(section)
    assert "as asked for" in message
    assert "Median depth –" in message
    for absent in ("left out", "Moving.", "Seen by.", "point cloud", "webp"):
        assert absent not in section


def test_overlarge_picture_is_refused(surface: Path, faintfield: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_surface, "MAX_PREVIEW_BYTES", 1000)
    ended = faintfield("report", surface)
    assert (ended.returncode, "MissingFile" in ended.stderr) == (1, True)
