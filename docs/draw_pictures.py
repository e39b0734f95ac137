"""Draw the picture of README.md from a finished demo: `python docs/draw_pictures.py demo`."""

import sys
from pathlib import Path

import numpy as np

from pipelines.frames import read_frame
from pipelines.image_files import contact_sheet, grey_levels, shrunk, write_png
from rig.session.opening import taken_frames

_WHITE_E = 1.5
_VIEW = ("dark_scene", (3, 3))
_TRUCK, _AIRPLANE = "plane_00500.0.tiff", "plane_00700.0.tiff"


def draw(demo: Path, out: Path) -> None:
    """Write one dark view beside both planes, back-projected and by PMLEM, on one grey scale."""
    (path,) = [path for frame, _, path in taken_frames(demo / "session") if (frame.kind, frame.stop.node) == _VIEW]
    view = read_frame(path).pixels_dn
    black, white = np.quantile(view, (0.001, 0.999))
    planes = [
        grey_levels(read_frame(demo / "session" / "reconstructions" / method / name).pixels_dn, _WHITE_E)
        for name in (_TRUCK, _AIRPLANE)
        for method in ("backprojection", "pmlem-osl")
    ]
    one_view = grey_levels(view, float(white), float(black))
    pictures = [one_view, *planes[:2], one_view, *planes[2:]]
    write_png(out, shrunk(contact_sheet(pictures, columns=3), 1280))


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(__file__).parent / "pictures" / "demo.png")
