"""The record of what a capture will show, as `faintfield plan --json` prints it, and its text for people.

A number that is not known says why; an interval is that of the light, if this was estimated from a frame.
"""

import math

from msgspec import Struct

from faintfield.calib.estimate import Estimate
from faintfield.pipelines.console import inform
from faintfield.rig.capture.guide import format_duration
from faintfield.rig.plan import Until

# Heads and widths of the table's columns.
_COLUMNS = (
    *(("exposure", 10), ("grid", 9), ("frames", 6), ("SNR", 8), ("sigma", 8), ("contrast", 8)),
    *(("scene", 9), ("session", 9)),
)


class FeaturePrediction(Struct, frozen=True, kw_only=True):
    """A square of a size: the contrast from which it is visible, and how sure the depth of a black one is.

    Contrast is the difference of its light to that of its surroundings over the latter; a black square has 1.
    """

    side_px: float
    side_mm: Estimate
    smallest_contrast: Estimate
    depth_sigma_mm: Estimate


class DepthPrediction(Struct, frozen=True, kw_only=True):
    """A plane at a depth, in the middle of the reference view; where all views see a sample if no depth is known.

    `sigma_e` is the standard deviation of a sample, as wide as a pixel, of the unpenalised estimate, in electrons of
    all frames of a view. `depth_step_mm` is the change of depth that moves a point by a pixel between the outermost
    views, and `blur_mm` the standard deviation of the lens's blur on the plane.
    """

    depth_mm: float | None
    views: int
    seen_by_all_mm: tuple[float, float] | None
    sigma_e: Estimate
    mm_per_px: Estimate
    blur_mm: Estimate
    depth_step_mm: Estimate
    features: list[FeaturePrediction]


class Alternative(Struct, frozen=True, kw_only=True):
    """One row of the table: another exposure, grid or number of frames, at the depth that the fewest views see.

    A dark scene in rounds takes as many `rounds`, of `frames_per_node` each, as reach its wanted noise.
    `snr` is that of one elemental image by eq. (4). `sigma_e` is in electrons of one frame of the record's
    `exposure_s`, so that rows can be compared. `scene_s` is the duration of the dark scene, `time_s` that of the
    session without prompts.
    """

    exposure_s: float
    rows: int
    columns: int
    frames_per_node: int
    rounds: int = 1
    snr: Estimate
    sigma_e: Estimate
    smallest_contrast: Estimate
    scene_s: Estimate
    time_s: Estimate
    why_not: str | None = None


class PredictionRecord(Struct, frozen=True, kw_only=True):
    """Prediction of what a capture will show.

    `light_e` and `photons` are expected in the first frame of the dark scene at a node, of `exposure_s`. `snr` and
    `snr_linear` are those of an elemental image of a uniform object, by eq. (4) and eq. (7). `pixel_share` is the part
    of the pixels that have the scarcest colour; by `rose_k` standard deviations a visible square stands out. `cheapest`
    is the shortest session that reaches `wanted_sigma_e`. `vignetting` says why it is not known. A dark scene with
    `until` will take `rounds`, in all of which there are `frames_per_node`; a sample then has the noise `reached_e`, in
    electrons of one frame of `exposure_s`.
    """

    rig: str
    rows: int
    columns: int
    pitch_mm: float
    exposure_s: float
    total_exposure_s: float
    frames_per_node: int
    noise_from: str
    read_noise_e: Estimate
    dark_current_e_per_s: Estimate
    light_from: str
    light_e: Estimate
    photons: Estimate
    pixel_share: float
    snr: Estimate
    snr_linear: Estimate
    vignetting: str | None
    rose_k: float
    depths: list[DepthPrediction]
    time_s: Estimate
    alternatives: list[Alternative]
    wanted_sigma_e: float | None = None
    cheapest: Alternative | None = None
    until: Until | None = None
    rounds: int = 1
    reached_e: Estimate | None = None


def print_prediction(record: PredictionRecord) -> None:
    """Print the prediction for people."""
    known_s = record.time_s.value
    time = f"unknown: {record.time_s.why}" if known_s is None else f"{format_duration(known_s)} without prompts"
    shape = f"{record.rows} x {record.columns} nodes {record.pitch_mm:g} mm apart"
    inform(f"{record.rig}: {shape}, frames at each: {record.frames_per_node}, {_exposures(record)}; {time}")
    noise, dark = _number_text(record.read_noise_e, "e⁻"), _number_text(record.dark_current_e_per_s, "e⁻/s")
    inform(f"noise: read noise {noise}; dark current {dark}; from {record.noise_from}")
    if record.until is not None and record.reached_e is not None:
        inform(f"rounds: {_describe_rounds(record.until, record.rounds, record.reached_e)}")
    light = f"{_number_text(record.light_e, 'e⁻')} per pixel in a frame, photons: {_number_text(record.photons)}"
    inform(f"light: {light}; {record.light_from}")
    snrs = f"SNR {_number_text(record.snr)} by eq. (4), {_number_text(record.snr_linear)} by eq. (7)"
    inform(f"one elemental image of an even object: {snrs}")
    for depth in record.depths:
        _print_depth(depth, record)
    inform("sigma: of one sample, as wide as a pixel, on the axis, estimated without a penalty, which lowers it")
    if record.pixel_share < 1:
        inform(f"colours: of the scarcest one, which {record.pixel_share:.0%} of the pixels have")
    if record.vignetting is not None:
        inform(f"vignetting: unknown: {record.vignetting}; none is assumed")
    _print_table(record)


def _describe_rounds(until: Until, rounds: int, reached_e: Estimate) -> str:
    wanted, most = f"the wanted sigma of {until.sigma_e:g} e⁻ in one frame", until.at_most_rounds
    if reached_e.value is None:
        return f"all {most}, unless the capture measures that fewer reach {wanted}; sigma is unknown: {reached_e.why}"
    if reached_e.value > until.sigma_e:
        return f"all {most} reach {reached_e.value:.3g} e⁻, not {wanted}; expose longer, or raise at_most_rounds"
    return f"{rounds} of at most {most} reach {reached_e.value:.3g} e⁻, {wanted}"


def _print_depth(depth: DepthPrediction, record: PredictionRecord) -> None:
    name = "plane at unknown depth" if depth.depth_mm is None else f"plane at {depth.depth_mm:g} mm"
    everywhere = depth.seen_by_all_mm
    count = record.rows * record.columns
    views = f"where all {count} views see it"
    if everywhere is not None:
        part = f"{everywhere[0]:.0f} x {everywhere[1]:.0f} mm" if min(everywhere) > 0 else "no part"
        views = f"its middle is seen by {depth.views} of {count} views, {part} by all"
    inform(f"{name}: {views}; sigma {_number_text(depth.sigma_e, 'e⁻')} in all frames of a node together")
    across, blur = _number_text(depth.mm_per_px, "mm"), _number_text(depth.blur_mm, "mm")
    inform(
        f"  a pixel: {across}; blur: {blur}; a pixel of parallax: {_number_text(depth.depth_step_mm, 'mm')} of depth"
    )
    for feature in depth.features:
        side = f"{feature.side_px:.3g} px ({_number_text(feature.side_mm, 'mm')})"
        contrast = _number_text(feature.smallest_contrast)
        contrast += ", so none is" if (feature.smallest_contrast.value or 0.0) > 1 else ""
        inform(f"  square of {side}: visible (k = {record.rose_k:g}) from contrast {contrast}")
        inform(f"    depth of a black one: +- {_number_text(feature.depth_sigma_mm, 'mm')}")


def _print_table(record: PredictionRecord) -> None:
    inform(f"sigma in e⁻ of one frame of {1e3 * record.exposure_s:g} ms; contrast of the first square")
    inform(" ".join(f"{head:>{wide}}" for head, wide in _COLUMNS))
    for row in record.alternatives:
        numbers = f"{_cell(row.snr)} {_cell(row.sigma_e)} {_cell(row.smallest_contrast)}"
        times = f"{_minutes(row.scene_s)} {_minutes(row.time_s)}"
        inform(f"{_asked(row)} {numbers} {times}{'' if row.why_not is None else '  not possible'}")
    hindrances = {f"not possible: {row.why_not}": None for row in record.alternatives if row.why_not is not None}
    unknown = {f"time unknown: {row.time_s.why}": None for row in record.alternatives if row.time_s.value is None}
    for reason in hindrances | unknown:
        inform(reason)
    wanted = f"sigma of {record.wanted_sigma_e:g} e⁻" if record.wanted_sigma_e is not None else ""
    if wanted and record.cheapest is None:
        inform(f"{wanted}: none of these is known to reach it; give longer exposures or more")
    elif record.cheapest is not None:
        inform(f"{wanted} in the shortest session:")
        inform(f"{_asked(record.cheapest)} {'':>8} {_cell(record.cheapest.sigma_e)}")


def _asked(row: Alternative) -> str:
    shape = f"{row.rows} x {row.columns}"
    frames = f"{row.rounds} x {row.frames_per_node}" if row.rounds > 1 else str(row.frames_per_node)
    return f"{1e3 * row.exposure_s:>7g} ms {shape:>9} {frames:>6}"


def _number_text(number: Estimate, unit: str = "") -> str:
    """Return a number with its unit and interval, or why it is unknown."""
    if number.value is None:
        return f"unknown: {number.why}"
    ends = "" if number.ci95 is None else f" (95 %: {number.ci95[0]:.3g} to {number.ci95[1]:.3g})"
    return f"{number.value:.3g}{' ' if unit else ''}{unit}{ends}"


def _cell(number: Estimate) -> str:
    return f"{'unknown' if number.value is None else format(number.value, '.3g'):>8}"


def _minutes(number: Estimate) -> str:
    return f"{'unknown' if number.value is None else format(number.value / 60, '.1f') + ' min':>9}"


def _exposures(record: PredictionRecord) -> str:
    total_ms, first_ms = 1e3 * record.total_exposure_s, 1e3 * record.exposure_s
    if math.isclose(total_ms, record.frames_per_node * first_ms):
        return f"{first_ms:g} ms"
    return f"{total_ms:g} ms together, the first {first_ms:g} ms"
