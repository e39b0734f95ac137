"""Light fields of the HCI 4D benchmark: `parameters.cfg` with lens, spacing and focus, and the true depth beside it.

The files count cameras row by row, `input_Cam000.png` the first. Views are sheared so that what lies at the distance of
focus does not move from view to view. Disparities in the files are positive where a point is nearer than that.
"""

import configparser
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue, WrongSize
from faintfield.pipelines.formats.exchange.image_grid import ImageGrid
from faintfield.pipelines.formats.files import sha256, write_json
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import ONE_PIXEL, write_plane
from faintfield.pipelines.formats.reading import is_file, read_text
from faintfield.pipelines.formats.sets.ground_truth import TRUE_DEPTH_FILE, TrueDepth
from faintfield.pipelines.formats.units import MAX_LENGTH_MM, MAX_NODE

# Size in bytes up to which the file is read; it has some two thousand.
_MAX_BYTES = 1_000_000

# True disparity in px, or true depth in m, of the centre view.
_DISPARITY, _DEPTH = "gt_disp_lowres.pfm", "gt_depth_lowres.pfm"

_MM_PER_M = 1000.0


@dataclass(frozen=True)
class DescribedGrid:
    """Content of `parameters.cfg`: rows and columns of the cameras, width and height of a picture, focal length.

    `pitch_mm` is the distance between neighbouring cameras, `focus_mm` the depth that does not move from view to view.
    """

    file: Path
    size: tuple[int, int]
    picture_px: tuple[int, int]
    fx_px: float
    pitch_mm: float
    focus_mm: float

    def scale(
        self, pitch_mm: float | None, fx_px: float | None, disparity_px: float | None
    ) -> tuple[float, float, float]:
        """Return pitch, focal length and disparity at the depth of focus: those given, else those of the file."""
        inform(
            f"{self.file}: cameras {self.pitch_mm:g} mm apart, focal length {self.fx_px:g} px, focus at "
            f"{self.focus_mm:g} mm" + ("; options take their place" if pitch_mm or fx_px or disparity_px else "")
        )
        pitch_mm, fx_px = pitch_mm or self.pitch_mm, fx_px or self.fx_px
        return pitch_mm, fx_px, fx_px * pitch_mm / self.focus_mm if disparity_px is None else disparity_px

    def depth_mm(self, disparity_px: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the depth of the benchmark's disparities, NaN where there is none in front of the cameras."""
        inverse = 1 / self.focus_mm + np.asarray(disparity_px, np.float64) / (self.fx_px * self.pitch_mm)
        return np.where(inverse > 0, 1 / np.where(inverse > 0, inverse, 1.0), np.nan)


def described_grid(folder: Path) -> DescribedGrid | None:
    """Return what the `parameters.cfg` in a folder states; None if there is none, or none of this benchmark.

    Raises
    ------
    BadValue
        A number is missing, or impossible.
    """
    path = folder / "parameters.cfg"
    if not is_file(path):
        return None
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(read_text(path, _MAX_BYTES))
    except configparser.Error as failure:
        reason = " ".join(str(failure).split())
        raise BadValue(
            f"{path}: is no configuration that can be read ({reason}); restore or remove it, and give --pitch-mm"
        ) from failure
    if not (parser.has_section("intrinsics") and parser.has_section("extrinsics")):
        return None
    width, height = (int(_number(path, parser, "intrinsics", f"image_resolution_{axis}_px", 65535)) for axis in "xy")
    columns, rows = (int(_number(path, parser, "extrinsics", f"num_cams_{axis}", MAX_NODE)) for axis in "xy")
    focal_mm = _number(path, parser, "intrinsics", "focal_length_mm", MAX_LENGTH_MM)
    sensor_mm = _number(path, parser, "intrinsics", "sensor_size_mm", MAX_LENGTH_MM)
    return DescribedGrid(
        path,
        (rows, columns),
        (width, height),
        fx_px=focal_mm / sensor_mm * max(width, height),
        pitch_mm=_number(path, parser, "extrinsics", "baseline_mm", MAX_LENGTH_MM),
        focus_mm=_MM_PER_M * _number(path, parser, "extrinsics", "focus_distance_m", MAX_LENGTH_MM / _MM_PER_M),
    )


def _number(path: Path, parser: configparser.ConfigParser, section: str, key: str, largest: float) -> float:
    text = parser.get(section, key, fallback=None)
    try:
        number = float(text or "")
    except ValueError:
        number = np.nan
    if not 1e-9 <= number <= largest:
        raise BadValue(
            f"{path}: [{section}] {key} = {text}; it must be a positive number of at most {largest:g}: correct it, or "
            "remove the file and give --pitch-mm, --fx-px and --disparity-px"
        )
    return number


def write_true_depth(described: DescribedGrid, grid: ImageGrid, folder: Path) -> None:
    """Write the true depth of the centre view into the folder of a set, if there is one beside `parameters.cfg`.

    Raises
    ------
    WrongSize
        The truth is of another size than the pictures.
    """
    sources = [described.file.with_name(name) for name in (_DISPARITY, _DEPTH)]
    source = next((path for path in sources if is_file(path)), None)
    rows, columns = grid.size
    centre = rows // 2, columns // 2
    at_centre = rows % 2 == 1 and columns % 2 == 1 and list(grid.paths)[grid.centre] == centre
    if source is None or grid.size != described.size or not at_centre:
        return
    values = read_frame(source).pixels_dn
    if values.shape != described.picture_px[::-1]:
        raise WrongSize(
            f"{source}: is of shape {values.shape} (rows, columns), the pictures are "
            f"{described.picture_px[0]} x {described.picture_px[1]} px; restore it, or move it away"
        )
    depth_mm = described.depth_mm(values) if source.name == _DISPARITY else _MM_PER_M * values.astype(np.float64)
    write_plane(
        folder / "true_depth_mm.tiff", np.where((depth_mm > 0) & np.isfinite(depth_mm), depth_mm, np.nan), ONE_PIXEL
    )
    write_json(folder / TRUE_DEPTH_FILE, TrueDepth(1, "true_depth_mm.tiff", source.name, sha256(source)))
    inform(f"{source.name}: is kept as the true depth of the centre view, and depth maps are compared with it")
