"""Figures 2, 3 and 4 of the paper from simulated light, with their numbers: the work of `faintfield figures`."""

import csv
import io
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.arguments import FigureNumber, SolverOptions
from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.files import check_free, exclusive, remove, write_json, write_whole
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.provenance import Provenance, provenance
from faintfield.pipelines.formats.results.figures import PhotonsRecord, SnrRecord
from faintfield.pipelines.formats.results.geometry import DEFAULT_DEPTHS_MM
from faintfield.pipelines.formats.results.records import Method, PlaneRecord
from faintfield.pipelines.formats.sets.elemental_set import NOISE_REFERENCE, load_set
from faintfield.pipelines.formats.sets.ground_truth import read_truth, texture_and_region
from faintfield.pipelines.pages.page import data_uri, template
from faintfield.pipelines.pages.report import write_report
from faintfield.pipelines.paper.figure4 import (
    BEST,
    METHODS,
    OURS,
    PAPERS_AXIS,
    PEER,
    TOTAL_VARIATION,
    CurvePoint,
    ErrorPoint,
    is_monotone,
    mean_curves,
    measure_errors,
    over_best,
    read_peer_table,
)
from faintfield.pipelines.paper.figure_drawings import DrawnPlane, draw_figure2, draw_figure3, draw_figure4
from faintfield.pipelines.reconstruction.overview import INTEGRAL_IMAGE, grey_scale_dn
from faintfield.pipelines.reconstruction.request import DEFAULT_METHOD, Request
from faintfield.pipelines.reconstruction.run import Outcome, reconstruct_set
from faintfield.pipelines.simulation.options import SyntheticOptions
from faintfield.pipelines.simulation.synthetic_set import NOISE_FREE, write_synthetic_set
from faintfield.recon.blur import blurred

PAGE_FILE = "figures.html"
_CURVES_FILE = "figure4_curves.json"

_SCENE, _BRIGHT, _DARK = "dark-scene", "bright", "dark"

# Detail is what this blur removes; its standard deviation is 2 samples.
_DETAIL_BLUR = (1, 1, 1, 1, 2)


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


class Figure4(msgspec.Struct, frozen=True):
    """The curves of figure 4.

    `monotone` tells of each method if every object's error falls from each SNR to the next; `over_best` is the largest
    ratio of total variation's error to that with the best weight, of each object.
    """

    monotone: dict[str, bool]
    over_best: dict[str, float]
    curves: list[CurvePoint]


class Figure4Curves(Figure4, frozen=True):
    """`figure4_curves.json`: the curves, and the width and height of the detector."""

    size_px: tuple[int, int]


type Row = DetailRow | DarkPlaneRow | ErrorPoint

# By the number of a figure, the type of its JSON file.
_KINDS = {2: Figure2, 3: Figure3, 4: list[ErrorPoint]}


class FigureOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of `faintfield figures`, as its help explains them and each figure's provenance records them."""

    only: list[FigureNumber]
    snr: float
    seed: int
    seeds: int
    size_px: tuple[int, int]


class FiguresMade(msgspec.Struct, frozen=True):
    """The result of `faintfield figures`: the folder, its page, and the numbers by figure."""

    out: str
    report: str
    figures: dict[str, Figure2 | Figure3 | Figure4]


class _FigureProvenance(Provenance[dict[str, object]], frozen=True, kw_only=True):
    """Provenance of a figure, which is written last: with it, the figure is whole."""

    wall_time_s: float


def make_figures(out: Path, options: FigureOptions) -> FiguresMade:
    """Write the figures that are asked for, their numbers and the page.

    Raises
    ------
    OutputExists
        `out` holds something other than earlier figures.
    """
    check_free(out, replace_if=PAGE_FILE)
    if {2, 3} & set(options.only):
        inform("simulating 7 x 7 views of a toy truck at 500 mm and a toy airplane at 700 mm")
        scene = SyntheticOptions(snr=options.snr, seed=options.seed, size_px=options.size_px)
        write_synthetic_set(out / _SCENE, scene, overwrite=True)
    makers: dict[int, Callable[[Path, FigureOptions], Figure2 | Figure3 | Figure4]]
    makers = {2: _figure2, 3: _figure3, 4: _figure4}
    numbers: dict[str, Figure2 | Figure3 | Figure4] = {}
    for number in options.only:
        start_s = time.monotonic()
        remove(_provenance_path(out, number))
        numbers[f"figure{number}"] = makers[number](out, options)
        origin = msgspec.structs.asdict(provenance("figures", msgspec.structs.asdict(options), {}))
        wall_time_s = time.monotonic() - start_s
        write_json(_provenance_path(out, number), _FigureProvenance(**origin, wall_time_s=wall_time_s))
        inform(f"figure {number}: {wall_time_s:.1f} s")
    _write_page(out)
    return FiguresMade(str(out), str(out / PAGE_FILE), numbers)


def _figure2(out: Path, _: FigureOptions) -> Figure2:
    """Back-project the bright set, and measure how much of each object's detail each plane shows."""
    outcome = _reconstruct(out / _SCENE / NOISE_FREE, out / _BRIGHT, "backprojection")
    planes = _read_planes(out / _BRIGHT, outcome.planes)
    integral = read_frame(out / _BRIGHT / INTEGRAL_IMAGE).pixels_dn
    rows = [row for pixels, plane in planes for row in _detail_rows(out / _SCENE, pixels, plane.depth_mm)]
    numbers = Figure2(rows)
    _write(out, 2, draw_figure2(integral, planes), rows, numbers)
    return numbers


def _detail_rows(scene: Path, pixels: NDArray[np.float32], depth_mm: float) -> list[DetailRow]:
    """Return the share of each object's detail that a plane shows.

    Detail d is what a small blur removes. The share is `<d_plane · d_object> / <d_object²>` over the region where the
    object is visible, so that the detail of other objects does not count.
    """
    truth = read_truth(scene)
    assert truth is not None
    rows = []
    for known in truth.planes:
        texture, region = texture_and_region(scene, known)
        of_plane, of_object = ((image - blurred(image, _DETAIL_BLUR))[region] for image in (pixels, texture))
        share = float(np.sum(of_plane * of_object) / np.sum(np.square(of_object)))
        rows.append(DetailRow(depth_mm, known.name, known.depth_mm, share))
    return rows


def _figure3(out: Path, _: FigureOptions) -> Figure3:
    """Reconstruct the dark set, and measure the errors of its planes."""
    outcome = _reconstruct(out / _SCENE, out / _DARK, DEFAULT_METHOD)
    metrics = outcome.metrics
    assert metrics is not None
    assert metrics.snr
    assert metrics.snr.measured is not None
    assert metrics.photons_per_px
    rows = [
        DarkPlaneRow(
            *(errors.depth_mm, errors.object, errors.method, errors.mse_bright, errors.mse_texture, errors.psnr_db),
            penalty_weight=record.penalty_weight,
            passes=record.passes,
        )
        for errors, record in zip(metrics.planes, outcome.planes, strict=True)
    ]
    numbers = Figure3(metrics.snr, metrics.photons_per_px, rows)
    elemental_set = load_set(out / _SCENE)
    dark = read_frame(elemental_set.image_paths[elemental_set.reference_view]).pixels_dn
    reference = read_frame(out / _SCENE / NOISE_REFERENCE).pixels_dn
    planes = _read_planes(out / _DARK, outcome.planes)
    picture = draw_figure3(dark, reference, grey_scale_dn(dark), metrics.snr.measured, planes)
    _write(out, 3, picture, rows, numbers)
    return numbers


def _figure4(out: Path, options: FigureOptions) -> Figure4:
    errors = measure_errors(options.size_px, options.seeds)
    points = mean_curves(errors)
    measured = {point.method for point in points}
    monotone = {method.name: is_monotone(points, method.name) for method in METHODS if method.name in measured}
    numbers = Figure4(monotone, over_best(points, TOTAL_VARIATION, BEST), points)
    write_json(out / _CURVES_FILE, Figure4Curves(**msgspec.structs.asdict(numbers), size_px=options.size_px))
    _write(out, 4, draw_figure4(points), errors, errors)
    return numbers


def _reconstruct(set_path: Path, out: Path, method: Method) -> Outcome:
    with exclusive(out):
        outcome = reconstruct_set(
            load_set(set_path), out, Request([*DEFAULT_DEPTHS_MM], [method], SolverOptions(prior="auto"))
        )
        write_report(out)
    return outcome


def _read_planes(folder: Path, records: Sequence[PlaneRecord]) -> list[DrawnPlane]:
    return [(read_frame(folder / plane.file).pixels_dn, plane) for plane in records]


def _write(out: Path, number: int, picture: bytes, rows: Sequence[Row], numbers: Any) -> None:
    table = io.StringIO()
    writer = csv.DictWriter(table, rows[0].__struct_fields__, lineterminator="\n")
    writer.writeheader()
    writer.writerows(msgspec.structs.asdict(row) for row in rows)
    write_whole(out / f"figure{number}.csv", table.getvalue())
    write_whole(out / f"figure{number}.png", picture)
    write_json(out / f"figure{number}.json", numbers)


def _provenance_path(folder: Path, number: int) -> Path:
    return folder / f"figure{number}_provenance.json"


def _write_page(folder: Path) -> None:
    figures = {
        number: {
            "src": data_uri((folder / f"figure{number}.png").read_bytes(), ".png"),
            "numbers": msgspec.json.decode((folder / f"figure{number}.json").read_bytes(), type=kind),
            "provenance": msgspec.json.decode(path.read_bytes(), type=_FigureProvenance),
        }
        for number, kind in _KINDS.items()
        if (path := _provenance_path(folder, number)).is_file()
    }
    curves = None
    if 4 in figures:
        curves = msgspec.json.decode((folder / _CURVES_FILE).read_bytes(), type=Figure4Curves)
    page = template(PAGE_FILE).render(
        found=figures,
        curves=curves,
        methods=[method for method in METHODS if curves is None or method.name in curves.monotone],
        ours=OURS,
        peer=read_peer_table() if curves is not None and PEER in curves.monotone else None,
        papers_axis=PAPERS_AXIS,
    )
    write_whole(folder / PAGE_FILE, page)
