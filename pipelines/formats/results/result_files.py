"""Reading the JSON files of results, with a named failure for a damaged one."""

from pathlib import Path
from typing import Annotated, Any

import msgspec

from faintfield.pipelines.errors import BadValue


class Measured(msgspec.Struct):
    """A number of noise.json."""

    value: float | None
    why: str | None = None
    ci95: tuple[float, float] | None = None


class Noise(msgspec.Struct):
    """What the page needs of noise.json."""

    offset_dn: Measured
    gain_dn_per_e: Measured
    read_noise_e: Measured
    dark_current_e_per_s: Measured
    likelihood: str
    frames: list[dict[str, Any]]
    temperature_c: dict[str, float] | None = None


class StageFigure(msgspec.Struct):
    """A number of the `stage` of geometry.json."""

    value: float | None
    sigma: float | None


class Stage(msgspec.Struct):
    """What the page needs of the `stage` of geometry.json."""

    pitch_x_mm: StageFigure
    pitch_y_mm: StageFigure
    scale_x: StageFigure
    scale_y: StageFigure
    squareness_rad: StageFigure
    backlash_x_mm: StageFigure
    backlash_y_mm: StageFigure
    tilt_rad: StageFigure
    node_residual_rms_mm: StageFigure
    residuals_mm: list[tuple[float, float, float]] | None


class Node(msgspec.Struct):
    """What the page needs of a node of geometry.json."""

    node: tuple[int, int]
    sigma_mm: float
    sigma_rad: float


class Geometry(msgspec.Struct):
    """What the page needs of geometry.json."""

    nodes: Annotated[list[Node], msgspec.Meta(min_length=1)]
    reference_node: tuple[int, int]
    stage: Stage
    transfer_sigma_px: dict[str, float]
    rms_inlier_px: float
    corners: int
    outliers: int


def read_result(path: Path, kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Read a JSON file whole, after checking that it holds what `kind` names.

    Raises
    ------
    BadValue
        It does not.
    """
    try:
        content: dict[str, Any] = msgspec.json.decode(path.read_bytes())
        msgspec.convert(content, kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, OSError) as failure:
        raise BadValue(f"{path}: is not a result that can be shown ({failure}); reconstruct again") from failure
    return content


def read_record[Record](path: Path, kind: type[Record]) -> Record:
    """Read a JSON file as one of the types of `formats.results.records`.

    Raises
    ------
    BadValue
        The file is not of this type.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, OSError) as failure:
        raise BadValue(f"{path}: is not a result that can be shown ({failure}); reconstruct again") from failure
