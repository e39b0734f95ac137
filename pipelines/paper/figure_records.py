"""The numbers of the paper's figures: one type per row and per JSON file, for its writer, its page and its tests."""

import csv
import io
from collections.abc import Sequence

import msgspec

from faintfield.pipelines.formats.results.records import PhotonsRecord, SnrRecord


class DetailRow(msgspec.Struct, frozen=True):
    """Figure 2: the share of an object's detail that a plane shows, 1 where it is sharp."""

    plane_depth_mm: float
    object: str
    object_depth_mm: float
    detail: float


class Figure2(msgspec.Struct, frozen=True):
    """`figure2.json`: the bright back-projections."""

    planes: list[DetailRow]


class DarkPlaneRow(msgspec.Struct, frozen=True):
    """Figure 3: the errors of a plane that was reconstructed from dark views."""

    depth_mm: float
    object: str
    method: str
    mse_bright: float
    mse_texture: float
    psnr_db: float | None
    penalty_weight: float | None
    passes: int


class Figure3(msgspec.Struct, frozen=True):
    """`figure3.json`: how dark the views are, and how right the planes."""

    snr: SnrRecord
    photons_per_px: PhotonsRecord
    planes: list[DarkPlaneRow]


class ErrorPoint(msgspec.Struct, frozen=True):
    """Figure 4: the error of one object by one method, of one draw of the noise.

    Attributes
    ----------
    mse : float
        Mean square error against the back-projection of the views without noise, over the object, scaled to 0…1.
    mse_texture : float
        The same against the object itself.
    weight : float, optional
        The weight that was best for this object and SNR, where the method was given the best one.
    """

    object: str
    snr: float
    method: str
    mse: float
    seed: int
    mse_texture: float
    weight: float | None


class CurvePoint(msgspec.Struct, frozen=True):
    """Figure 4: the mean over the draws of the noise, and its standard error (None for a single draw)."""

    object: str
    method: str
    snr: float
    draws: int
    mse: float
    standard_error: float | None
    mse_texture: float


class Figure4(msgspec.Struct, frozen=True):
    """The curves of figure 4.

    Attributes
    ----------
    monotone : dict of str to bool
        By method, True if every object's error falls from each SNR to the next.
    over_best : dict of str to float
        For each object, the largest ratio of our error to that with the best weight.
    """

    monotone: dict[str, bool]
    over_best: dict[str, float]
    curves: list[CurvePoint]


class Figure4Curves(Figure4, frozen=True):
    """`figure4_curves.json`: the curves, and the width and height of the detector."""

    size_px: tuple[int, int]


type Row = DetailRow | DarkPlaneRow | ErrorPoint


def as_csv(rows: Sequence[Row]) -> str:
    """Return rows of one type as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0].__struct_fields__, lineterminator="\n")
    writer.writeheader()
    writer.writerows(msgspec.structs.asdict(row) for row in rows)
    return text.getvalue()
