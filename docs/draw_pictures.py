"""Make the pictures of README.md and the guide from a finished demo: `python docs/draw_pictures.py demo`.

Run it from the root of the repository. Chromium takes the pictures of the pages. With `FAINTFIELD_DATA`, the folder of
real data that tests read, photographs are darkened and reconstructed, too. `python docs/draw_pictures.py demo FOLDER`
takes the viewer of its report instead, on screens of three widths, bright and dark, and puts the pictures into the
folder. Those of a capture are made by docs/draw_capture.py.
"""

import base64
import io
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import contact_sheet, grey_levels, shrunk, write_png
from faintfield.recon.surface.confidence import SURE
from tests.end_to_end.browser import Tab, open_browser

_PICTURES = Path(__file__).parent / "pictures"
_WHITE_E = 1.5
_TRUCK, _AIRPLANE = "plane_00500.0.tiff", "plane_00700.0.tiff"
# Depths whose colours are the ends of the scale.
_DEPTHS_MM = (450.0, 750.0)
_WIDTH_PX = 1000
_MAIN = "from faintfield.pipelines.cli import main; main()"
_PAGES = (("report", "report.html", 1250), ("stage", "geometry.html", 1250), ("noise", "noise.html", 1750))

# Widths and heights of the screens on which the viewer is shown.
_SCREENS = ((1400, 1250), (1024, 1100), (390, 1500))

# What the guide shows of it: its name, the layout's button, and the share of the left picture.
_LAYOUTS = (("wipe", "Wipe", 0.42), ("pair", "Side by side", 0.5), ("all", "All", 0.5))


def draw_planes(demo: Path) -> None:
    """Draw a dark view and both planes; below, the mean of all views, the surface, and its sure depths."""
    view = read_frame(_first(demo, "*_dark_scene_*_r3_c3_*.tiff")).pixels_dn
    black, white = np.quantile(view, (0.001, 0.999))
    names = (f"occlusion/{_TRUCK}", f"occlusion/{_AIRPLANE}", f"backprojection/{_TRUCK}", "surface/picture.tiff")
    light = [grey_levels(read_frame(_first(demo, name)).pixels_dn, _WHITE_E) for name in names]
    grey = [grey_levels(view, float(white), float(black)), *light]
    pictures = [cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB) for picture in grey] + [_depth_where_sure(demo)]
    write_png(_PICTURES / "demo.png", shrunk(contact_sheet(pictures, 3), _WIDTH_PX))


def _depth_where_sure(demo: Path) -> NDArray[np.uint8]:
    """Return the depth of the surface in colours, dark grey where it is not sure."""
    depth_mm, probability = (
        read_frame(_first(demo, f"surface/{name}.tiff")).pixels_dn for name in ("depth_mm", "depth_confidence")
    )
    near_mm, far_mm = _DEPTHS_MM
    colours = colormaps["viridis"](np.clip((depth_mm - near_mm) / (far_mm - near_mm), 0, 1))[..., :3]
    sure = (np.nan_to_num(probability) >= SURE)[..., None]
    return np.where(sure, 255 * colours, 40).astype(np.uint8)


def draw_photographs(photographs: Path) -> None:
    """Darken photographs of a light field, reconstruct their surface, and draw a view, the picture and its depth."""
    with TemporaryDirectory() as scratch:
        dark, surface = Path(scratch) / "dark", Path(scratch) / "surface"
        for command in (
            ("import", "grid", photographs, Path(scratch) / "bright"),
            ("darken", Path(scratch) / "bright", dark, "--snr", "0.16", "--seed", "1"),
            ("reconstruct", dark, "--surface", "--out", surface),
        ):
            subprocess.run([sys.executable, "-c", _MAIN, *map(str, command)], check=True)
        view = read_frame(dark / "view_r4_c4.tiff").pixels_dn
        black, white = np.quantile(view, (0.001, 0.999))
        picture = cv2.cvtColor(cv2.imread(str(surface / "picture.png")), cv2.COLOR_BGR2RGB)
        disparity_px, probability = (
            read_frame(surface / f"{name}.tiff").pixels_dn for name in ("disparity_px", "depth_confidence")
        )
        sure = np.nan_to_num(probability) >= SURE
        near_px, far_px = np.quantile(disparity_px[sure], (0.01, 0.99))
        colours = 255 * colormaps["viridis"](np.clip((disparity_px - near_px) / (far_px - near_px), 0, 1))[..., :3]
        depth = np.where(sure[..., None], colours, 0.35 * colours + 26).astype(np.uint8)
        dark_view = grey_levels(view, float(white), float(black))
        pictures = [dark_view, np.asarray(picture, np.uint8), _with_scale(depth, near_px, far_px)]
        write_png(_PICTURES / "photographs.png", shrunk(contact_sheet(pictures, 3), _WIDTH_PX))


def _with_scale(depth: NDArray[np.uint8], near_px: float, far_px: float) -> NDArray[np.uint8]:
    """Return a map of disparities in colours (row, column, RGB) with the scale of these in a strip at its lower end."""
    height, width = depth.shape[:2]
    strip, bar = height // 10, height // 40
    colours = 255 * colormaps["viridis"](np.linspace(0, 1, width // 3))[:, :3]
    shown = depth.copy()
    shown[-strip:] = 0
    shown[height - strip // 2 - bar : height - strip // 2 + bar, width // 3 : width // 3 + len(colours)] = colours
    words = (f"near {near_px:.1f} px", width // 60), (f"far {far_px:.1f} px", 2 * width // 3 + width // 60)
    for text, left in words:
        place = (left, height - strip // 3)
        cv2.putText(shown, text, place, cv2.FONT_HERSHEY_SIMPLEX, width / 750, (255, 255, 255), 2, cv2.LINE_AA)
    return shown


def draw_pages(demo: Path) -> None:
    """Take the pages of a reconstruction, a stage and a sensor as a browser shows them."""
    with TemporaryDirectory() as scratch, open_browser(Path(scratch) / "browser") as tab:
        tab.call("Emulation.setScrollbarsHidden", hidden=True)
        for name, page, height_px in _PAGES:
            _resize(tab, height_px)
            tab.open(_first(demo, page).resolve().as_uri())
            tab.wait_until("document.readyState == 'complete' && location.protocol == 'file:'")
            tab.wait_until("!document.getElementById('viewer') || document.querySelector('.v-stage')?.dataset.ready")
            _take(tab, name)
        _show_viewer(tab, demo, "All", 0.5)
        tab.call("Emulation.setDeviceMetricsOverride", width=1100, height=1140, deviceScaleFactor=1, mobile=False)
        tab.evaluate("document.getElementById('viewer').scrollIntoView()")
        _take(tab, "viewer")


def draw_viewer(demo: Path, folder: Path) -> None:
    """Take the viewer of a report on screens of all widths, bright and dark, in each of its layouts."""
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as scratch, open_browser(Path(scratch) / "browser") as tab:
        tab.call("Emulation.setScrollbarsHidden", hidden=True)
        for width_px, height_px in _SCREENS:
            for scheme in ("light", "dark"):
                feature = {"name": "prefers-color-scheme", "value": scheme}
                tab.call("Emulation.setEmulatedMedia", media="", features=[feature])
                size = {"width": width_px, "height": height_px}
                tab.call("Emulation.setDeviceMetricsOverride", **size, deviceScaleFactor=1, mobile=width_px < 500)
                for name, button, share in _LAYOUTS:
                    _show_viewer(tab, demo, button, share)
                    taken = tab.call("Page.captureScreenshot", format="png")["data"]
                    (folder / f"viewer_{name}_{width_px}_{scheme}.png").write_bytes(base64.b64decode(taken))
        if tab.complaints:
            raise AssertionError(tab.complaints)


def _show_viewer(tab: Tab, demo: Path, button: str, share: float) -> None:
    """Open the report with its viewer at the top, in a layout, with the line at a share of the width."""
    tab.open("about:blank")
    tab.open(_first(demo, "report.html").resolve().as_uri())
    tab.wait_until("document.querySelector('.v-stage').dataset.ready === 'all'")
    tab.evaluate(
        f"[...document.querySelectorAll('#viewer button')].find(it => it.textContent === '{button}').click(); "
        f"(it => {{ it.value = {share}; it.dispatchEvent(new Event('input')); }})(document.getElementById('v-wipe')); "
        "document.getElementById('viewer').scrollIntoView(); "
        "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done())))"
    )


def _resize(tab: Tab, height_px: int) -> None:
    """Set the height of the browser window; its width is that of all pictures."""
    size = {"width": 1100, "height": height_px}
    tab.call("Emulation.setDeviceMetricsOverride", **size, deviceScaleFactor=1, mobile=False)


def _take(tab: Tab, name: str) -> None:
    """Save what the browser shows as a picture of that name."""
    _keep(base64.b64decode(tab.call("Page.captureScreenshot", format="png")["data"]), name)


def _keep(content: bytes, name: str) -> None:
    """Write a PNG into the folder of pictures, smaller and in 256 colours, which is enough to look at."""
    with Image.open(io.BytesIO(content)) as picture:
        picture.thumbnail((_WIDTH_PX, 4 * _WIDTH_PX))
        reduced = picture.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        reduced.save(_PICTURES / f"{name}.png", optimize=True)


def _found(demo: Path, name: str) -> list[Path]:
    """Return the files of that name, those in shallower folders first."""
    return sorted(demo.rglob(name), key=lambda path: len(path.parts))


def _first(demo: Path, name: str) -> Path:
    """Return the first file of that name."""
    if found := _found(demo, name):
        return found[0]
    raise FileNotFoundError(f"no {name} in {demo}; run `faintfield demo {demo}` to its end")


if __name__ == "__main__":
    finished = Path(sys.argv[1])
    if len(sys.argv) > 2:
        draw_viewer(finished, Path(sys.argv[2]))
        sys.exit()
    draw_planes(finished)
    draw_pages(finished)
    if data := os.environ.get("FAINTFIELD_DATA"):
        draw_photographs(Path(data) / "lightfield-chess")
