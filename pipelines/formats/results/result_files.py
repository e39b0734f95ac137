"""What a report needs of the files beside planes, read such that a damaged one is told from a whole one."""

from pathlib import Path
from typing import Annotated, Any

import msgspec

from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.reconstruction.brightness import Brightness


class Record(msgspec.Struct):
    """What the page needs of a plane's entry in reconstruction.json."""

    file: str
    depth_mm: float
    method: str
    channel: str
    pitch_mm: float
    penalty_weight: float | None
    penalty_weight_chosen: str
    passes: int
    flux_e: float
    certificate: dict[str, Any] | None
    sigma_file: str | None = None
    opacity_file: str | None = None


class Focus(msgspec.Struct):
    """A focus curve and the depths it marks."""

    depth_mm: list[float]
    detail_e2: list[float]
    sharp_mm: list[float]


class DepthMap(msgspec.Struct):
    """What the page needs of a sweep's depth map."""

    file: str
    confidence: str
    all_in_focus: str
    unit: str
    bins_px: int
    sure_above: float
    sure_share: float


class Result(msgspec.Struct):
    """What the page needs of reconstruction.json."""

    planes: Annotated[list[Record], msgspec.Meta(min_length=1)]
    options: dict[str, Any]
    versions: dict[str, str]
    inputs: dict[str, str]
    wall_time_s: float
    focus: Focus | None = None
    depth_map: DepthMap | None = None


class ErrorRow(msgspec.Struct):
    """What the page needs of a row of metrics.json."""

    depth_mm: float
    object: str
    method: str
    poses: str
    mse_bright: float
    mse_texture: float
    psnr_db: float | None
    mse_plane: float | None = None


class Errors(msgspec.Struct):
    """What the page needs of metrics.json."""

    planes: list[ErrorRow]


class Overview(msgspec.Struct):
    """What the page needs of overview.json."""

    set: str
    views: int
    size_px: tuple[int, int]
    exposure_s: float
    read_noise_e: float
    brightness: Brightness


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
