"""`faintfield figures`: figures 2, 3 and 4 of the paper from the simulated rig, with their numbers."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from cyclopts import Parameter

from faintfield.pipelines.arguments import Count, Positive, Seed, SizePx
from faintfield.pipelines.commands.reconstruct import reconstruct
from faintfield.pipelines.commands.simulate import NOISE_FREE, simulate
from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.files import check_free, remove, write_json, write_whole
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.geometry import DEFAULT_DEPTHS_MM
from faintfield.pipelines.formats.results.records import Method
from faintfield.pipelines.formats.sets.elemental_set import NOISE_REFERENCE, load_set
from faintfield.pipelines.formats.sets.ground_truth import read_truth, texture_and_region
from faintfield.pipelines.pages.page import data_uri, template
from faintfield.pipelines.paper.figure4 import PAPERS_AXIS, as_csv, as_rows, curves, is_monotone, measure, over_best
from faintfield.pipelines.paper.figure_methods import BEST, METHODS, OURS
from faintfield.pipelines.reconstruction.overview import INTEGRAL_IMAGE, grey_scale_dn
from faintfield.pipelines.reconstruction.run import Outcome
from faintfield.recon.smoothing import blurred

PAGE_FILE = "figures.html"

_SCENE, _BRIGHT, _DARK = "dark-scene", "bright", "dark"

# Detail is what this blur removes; its standard deviation is 2 samples.
_DETAIL_BLUR = (1, 1, 1, 1, 2)


def figures(
    out: Path,
    /,
    *,
    only: Annotated[list[Literal[2, 3, 4]] | None, Parameter(consume_multiple=True)] = None,
    snr: Positive = 0.16,
    seed: Seed = 1,
    seeds: Count = 5,
    size_px: SizePx = (640, 480),
) -> dict[str, Any]:
    """Make figures 2, 3 and 4 of the paper from simulated light, and a page that puts them beside what it says.

    Figure 2: the bright integral image and its back-projections. Figure 3: one dark view, the noise reference, and the
    planes that penalised maximum likelihood finds. Figure 4: the error against the SNR for four objects. Each is a
    PNG with its numbers as JSON and CSV; figures.html shows all that are in OUT.

    Parameters
    ----------
    out
        Folder to write; the figures of an earlier call are kept where they are not made anew.
    only
        Which figures to make; all by default.
    snr
        Of the dark views of figure 3.
    seed
        Of all chance in figures 2 and 3.
    seeds
        Draws of the noise for each point of figure 4.
    size_px
        Width and height of the detector.
    """
    wanted = sorted(set(only or (2, 3, 4)))
    options = {"only": wanted, "snr": snr, "seed": seed, "seeds": seeds, "size_px": list(size_px)}
    check_free(out, replace_if=PAGE_FILE)
    if {2, 3} & set(wanted):
        inform("simulating 7 x 7 views of a toy truck at 500 mm and a toy airplane at 700 mm")
        simulate(out / _SCENE, snr=snr, seed=seed, size_px=size_px, overwrite=True)
    makers: dict[int, Callable[[], dict[str, Any]]] = {
        2: lambda: _figure2(out),
        3: lambda: _figure3(out),
        4: lambda: _figure4(out, size_px, seeds),
    }
    made = {}
    for number in wanted:
        started = time.monotonic()
        remove(out / f"figure{number}_provenance.json")
        made[f"figure{number}"] = makers[number]()
        record = msgspec.structs.asdict(provenance("figures", options, {})) | {
            "wall_time_s": time.monotonic() - started
        }
        write_json(out / f"figure{number}_provenance.json", record)
        inform(f"figure {number}: {time.monotonic() - started:.1f} s")
    return {"out": str(out), "report": str(_write_page(out)), "figures": made}


def _figure2(out: Path) -> dict[str, Any]:
    """Back-project the bright set, and measure how much of each object's detail each plane shows."""
    from faintfield.pipelines.paper.figure_drawings import draw_figure2

    planes, _ = _reconstructed(out / _SCENE / NOISE_FREE, out / _BRIGHT, "backprojection")
    integral = read_frame(out / _BRIGHT / INTEGRAL_IMAGE).pixels_dn
    rows = [
        {"plane_depth_mm": plane.depth_mm, "object": name, "object_depth_mm": depth, "detail": detail}
        for plane in planes
        for name, depth, detail in _details(out / _SCENE, plane.pixels)
    ]
    return _written(out, 2, draw_figure2(integral, planes), rows, {"planes": rows})


def _details(scene: Path, plane: Any) -> list[tuple[str, float, float]]:
    """Return for each object its name, its depth, and the share of its detail that a plane shows: 1 where sharp.

    Detail d is what a small blur removes. The share is `<d_plane · d_object> / <d_object²>` over the region where the
    object is visible, so that detail of something else does not count.
    """
    truth = read_truth(scene)
    assert truth is not None
    shares = []
    for known in truth.planes:
        texture, region = texture_and_region(scene, known)
        of_plane, of_object = ((image - blurred(image, _DETAIL_BLUR))[region] for image in (plane, texture))
        share = float(np.sum(of_plane * of_object) / np.sum(np.square(of_object)))
        shares.append((known.name, known.depth_mm, share))
    return shares


def _figure3(out: Path) -> dict[str, Any]:
    """Reconstruct the dark set, and keep how wrong that is."""
    from faintfield.pipelines.paper.figure_drawings import draw_figure3

    planes, result = _reconstructed(out / _SCENE, out / _DARK, OURS)
    loaded = load_set(out / _SCENE)
    dark = read_frame(loaded.image_paths[loaded.reference_view]).pixels_dn
    reference = read_frame(out / _SCENE / NOISE_REFERENCE).pixels_dn
    metrics = result.metrics
    assert metrics is not None
    measured = metrics.snr.measured
    assert measured is not None
    picture = draw_figure3(dark, reference, grey_scale_dn(dark), measured, planes)
    rows = [
        {
            **{
                key: getattr(row, key)
                for key in ("depth_mm", "object", "method", "mse_bright", "mse_texture", "psnr_db")
            },
            "penalty_weight": record.penalty_weight,
            "passes": record.passes,
        }
        for row, record in zip(metrics.planes, result.planes, strict=True)
    ]
    figures_of_light = {"snr": metrics.snr, "photons_per_px": metrics.photons_per_px}
    return _written(out, 3, picture, rows, figures_of_light | {"planes": rows})


def _reconstructed(elemental_set: Path, out: Path, method: Method) -> tuple[list[Any], Outcome]:
    """Reconstruct both planes of a set by a method, and return them with what `reconstruct` says."""
    from faintfield.pipelines.paper.figure_drawings import Shown

    result = reconstruct(elemental_set, out=out, depth_mm=[*DEFAULT_DEPTHS_MM], method=[method])
    planes = [
        Shown(read_frame(out / record.file).pixels_dn, record.depth_mm, record.pitch_mm, record.origin_mm)
        for record in result.planes
    ]
    return planes, result


def _figure4(out: Path, size_px: tuple[int, int], seeds: int) -> dict[str, Any]:
    """Measure the errors, and say whether they fall."""
    from faintfield.pipelines.paper.figure_drawings import draw_figure4

    errors = measure(size_px, seeds)
    points = curves(errors)
    rows = as_rows(errors)
    summary = {method.name: is_monotone(points, method.name) for method in METHODS}
    said = {"monotone": summary, "over_best": over_best(points, OURS, BEST), "curves": points}
    write_json(out / "figure4_curves.json", said | {"size_px": list(size_px)})
    _written(out, 4, draw_figure4(points), rows, rows)
    return said


def _written(out: Path, number: int, picture: bytes, rows: list[dict[str, Any]], numbers: Any) -> dict[str, Any]:
    """Write a figure and its numbers, and return those."""
    write_whole(out / f"figure{number}.csv", as_csv(rows))
    write_whole(out / f"figure{number}.png", picture)
    write_json(out / f"figure{number}.json", numbers)
    return {"planes": rows} if not isinstance(numbers, dict) else numbers


def _write_page(out: Path) -> Path:
    """Write figures.html of the figures that are in a folder, and return its path."""
    found: dict[int, dict[str, Any]] = {}
    for number in (2, 3, 4):
        if not (out / f"figure{number}_provenance.json").is_file():  # it is written last
            continue
        found[number] = {
            "src": data_uri((out / f"figure{number}.png").read_bytes(), ".png"),
            "numbers": msgspec.json.decode((out / f"figure{number}.json").read_bytes()),
            "provenance": msgspec.json.decode((out / f"figure{number}_provenance.json").read_bytes()),
        }
    table = None
    if 4 in found:
        table = msgspec.json.decode((out / "figure4_curves.json").read_bytes())
    page = template(PAGE_FILE).render(
        found=found,
        curves=table,
        methods=[method for method in METHODS if table is None or method.name in table["monotone"]],
        ours=OURS,
        papers_axis=PAPERS_AXIS,
    )
    path = out / PAGE_FILE
    write_whole(path, page)
    return path
