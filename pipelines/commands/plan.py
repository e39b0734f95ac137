"""`faintfield plan`: what a capture will show, before it is made."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from faintfield.pipelines.arguments import Count, Fraction, NotNegative, Positive
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import WrongUsage

if TYPE_CHECKING:
    from faintfield.pipelines.formats.results.noise_fit import Measured
    from faintfield.pipelines.formats.results.prediction import Alternative, DepthPrediction, PredictionRecord

type Result = PredictionRecord

# Heads and widths of the table's columns.
_COLUMNS = (
    *(("exposure", 10), ("grid", 9), ("frames", 6), ("SNR", 8), ("sigma", 8), ("contrast", 8)),
    *(("scene", 9), ("session", 9)),
)


def plan(
    rig: Path,
    /,
    *,
    light_e: Positive | None = None,
    light_e_per_s: Positive | None = None,
    flat: Path | None = None,
    test_frame: Path | None = None,
    frame_exposure_ms: Positive | None = None,
    region_px: tuple[int, int, int, int] | None = None,
    depth_mm: Annotated[list[Positive] | None, Parameter(consume_multiple=True)] = None,
    feature_px: Annotated[list[Positive] | None, Parameter(consume_multiple=True)] = None,
    feature_mm: Annotated[list[Positive] | None, Parameter(consume_multiple=True)] = None,
    sigma_e: Positive | None = None,
    exposures_ms: Annotated[list[Positive] | None, Parameter(consume_multiple=True)] = None,
    grids: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    frames: Annotated[list[Count] | None, Parameter(consume_multiple=True)] = None,
    noise: Path | None = None,
    read_noise_e: NotNegative | None = None,
    dark_current_e_per_s: NotNegative | None = None,
    quantum_efficiency: Fraction | None = None,
    geometry: Path | None = None,
    fx_px: Positive | None = None,
    blur_px: NotNegative | None = None,
    rose_k: Positive = 5.0,
) -> Result:
    """Predict what a capture will show: SNR, noise of the planes, smallest contrast, depth, and time.

    Stage and camera are asked for their speeds, and nothing moves. A table compares exposures, grids and frames per
    node, and with --sigma-e names the shortest session that reaches a wanted noise. What is not known is said to be
    unknown, and why. docs/capture.md explains the numbers, and compares them with simulated captures.

    Parameters
    ----------
    rig
        The rig.toml.
    light_e
        Light of the scene: electrons per pixel in one frame of the dark scene of the rig.toml.
    light_e_per_s
        The same, per second.
    flat
        A frame of even light as bright as the scene; its middle is taken.
    test_frame
        A frame of the scene, of any exposure; its mean is taken, with its interval.
    frame_exposure_ms
        Exposure of that frame; by default what its file states.
    region_px
        Left column, upper row, width and height of the object in that frame; by default all of a test frame.
    depth_mm
        Depths of planes; by default those of the rig.toml.
    feature_px
        Sides of squares to be seen, in pixels; by default 10.
    feature_mm
        The same, in mm at the first depth.
    sigma_e
        Noise of a sample that is wanted, in electrons of one frame of the rig.toml's exposure.
    exposures_ms
        Exposures of a frame to compare; by default that of the rig.toml.
    grids
        Grids to compare, such as 3x3 5x5, with the rig.toml's pitch and centre; by default its own.
    frames
        Numbers of frames at a node to compare; by default those of the rig.toml, or 1 if their exposures differ.
    noise
        noise.json of the camera, or its folder; by default beside the rig.toml, or a simulated camera's own.
    read_noise_e
        Read noise, instead of the measured one.
    dark_current_e_per_s
        Dark electrons per pixel and second, instead of the measured ones.
    quantum_efficiency
        Electrons per photon, instead of the measured ones.
    geometry
        geometry.json of the camera, or its folder; by default beside the rig.toml.
    fx_px
        Focal length in pixels, instead of the measured one.
    blur_px
        Standard deviation of the lens's blur; by default none is assumed.
    rose_k
        Standard deviations by which a visible feature stands out of its surroundings (Rose's criterion).
    """
    from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE
    from faintfield.pipelines.formats.results.noise import NOISE_FILE
    from faintfield.pipelines.formats.rig_file import read_rig
    from faintfield.pipelines.planning.known import calibration_file, known_lens, known_pace, known_sensor
    from faintfield.pipelines.planning.light import LightOptions
    from faintfield.pipelines.planning.predict import Predictor, Question, parse_grids, scene_view

    settings = read_rig(rig)
    sensor = known_sensor(
        settings,
        calibration_file(noise, NOISE_FILE, rig.parent),
        read_noise_e=read_noise_e,
        dark_current_e_per_s=dark_current_e_per_s,
        quantum_efficiency=quantum_efficiency,
    )
    lens = known_lens(settings, sensor, calibration_file(geometry, GEOMETRY_FILE, rig.parent), fx_px)
    exposures_s = [1e-3 * exposure_ms for exposure_ms in exposures_ms or []]
    exposure_s, view = scene_view(settings, exposures_s)
    frame_exposure_s = None if frame_exposure_ms is None else 1e-3 * frame_exposure_ms
    given = LightOptions(light_e, light_e_per_s, flat, test_frame, frame_exposure_s, region_px)
    depths_mm = depth_mm or settings.scene.depth_mm
    sides_px = [*(feature_px or []), *_in_px(feature_mm or [], depths_mm, lens.f_px)]
    question = Question(
        depths_mm, sides_px or [10.0], blur_px, rose_k, exposures_s, parse_grids(grids or []), frames or [], sigma_e
    )
    light = given.resolve(exposure_s, sensor)
    predictor = Predictor(settings, sensor, lens, known_pace(settings), light, question)
    record = predictor.record(str(rig), exposure_s, view)
    _inform_of(record)
    return record


def _exposures(record: "PredictionRecord") -> str:
    """Return the exposures of a node's frames in words."""
    total_ms, first_ms = 1e3 * record.total_exposure_s, 1e3 * record.exposure_s
    if math.isclose(total_ms, record.frames_per_node * first_ms):
        return f"{first_ms:g} ms"
    return f"{total_ms:g} ms together, the first {first_ms:g} ms"


def _in_px(sides_mm: list[float], depths_mm: "list[float] | tuple[float, ...]", f_px: "Measured") -> list[float]:
    """Return sides in pixels at the first depth."""
    if not sides_mm:
        return []
    if not depths_mm or f_px.value is None:
        raise WrongUsage(
            f"--feature-mm {sides_mm[0]:g}: pixels of it are not known without a depth and a focal length; give "
            "--depth-mm and --fx-px or --geometry, or --feature-px"
        )
    return [side_mm * f_px.value / depths_mm[0] for side_mm in sides_mm]


def _inform_of(record: "PredictionRecord") -> None:
    """Print the prediction for people."""
    from faintfield.rig.capture.guide import format_duration

    known_s = record.time_s.value
    time = f"unknown: {record.time_s.why}" if known_s is None else f"{format_duration(known_s)} without prompts"
    shape = f"{record.rows} x {record.columns} nodes {record.pitch_mm:g} mm apart"
    inform(f"{record.rig}: {shape}, frames at each: {record.frames_per_node}, {_exposures(record)}; {time}")
    noise, dark = _number_text(record.read_noise_e, "e⁻"), _number_text(record.dark_current_e_per_s, "e⁻/s")
    inform(f"noise: read noise {noise}; dark current {dark}; from {record.noise_from}")
    light = f"{_number_text(record.light_e, 'e⁻')} per pixel in a frame, photons: {_number_text(record.photons)}"
    inform(f"light: {light}; {record.light_from}")
    snrs = f"SNR {_number_text(record.snr)} by eq. (4), {_number_text(record.snr_linear)} by eq. (7)"
    inform(f"one elemental image of an even object: {snrs}")
    for depth in record.depths:
        _inform_of_depth(depth, record)
    inform("sigma: of one sample, as wide as a pixel, on the axis, estimated without a penalty, which lowers it")
    if record.pixel_share < 1:
        inform(f"colours: of the scarcest one, which {record.pixel_share:.0%} of the pixels have")
    if record.vignetting is not None:
        inform(f"vignetting: unknown: {record.vignetting}; none is assumed")
    _inform_of_table(record)


def _inform_of_depth(depth: "DepthPrediction", record: "PredictionRecord") -> None:
    """Print what is predicted of a plane."""
    name = "plane at unknown depth" if depth.depth_mm is None else f"plane at {depth.depth_mm:g} mm"
    everywhere = depth.seen_by_all_mm
    count = record.rows * record.columns
    views = f"where all {count} views see it"
    if everywhere is not None:
        part = f"{everywhere[0]:.0f} x {everywhere[1]:.0f} mm" if min(everywhere) > 0 else "no part"
        views = f"its middle is seen by {depth.views} of {count} views, {part} by all"
    inform(f"{name}: {views}; sigma {_number_text(depth.sigma_e, 'e⁻')}")
    across, blur = _number_text(depth.mm_per_px, "mm"), _number_text(depth.blur_mm, "mm")
    inform(
        f"  a pixel: {across}; blur: {blur}; a pixel of parallax: {_number_text(depth.depth_step_mm, 'mm')} of depth"
    )
    for feature in depth.features:
        side = f"{feature.side_px:.3g} px ({_number_text(feature.side_mm, 'mm')})"
        contrast = _number_text(feature.smallest_contrast)
        hidden = (feature.smallest_contrast.value or 0.0) > 1
        contrast += ", so none is" if hidden else ""
        inform(f"  square of {side}: visible (k = {record.rose_k:g}) from contrast {contrast}")
        inform(f"    depth of a black one: +- {_number_text(feature.depth_sigma_mm, 'mm')}")


def _inform_of_table(record: "PredictionRecord") -> None:
    """Print the table of alternatives, and the cheapest."""
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
    if record.wanted_sigma_e is None:
        return
    if record.cheapest is None:
        inform(
            f"sigma of {record.wanted_sigma_e:g} e⁻: none of these is known to reach it; give longer exposures or more"
        )
    else:
        inform(f"sigma of {record.wanted_sigma_e:g} e⁻ in the shortest session:")
        inform(f"{_asked(record.cheapest)} {'':>8} {_cell(record.cheapest.sigma_e)}")


def _asked(row: "Alternative") -> str:
    """Return what a row compares."""
    shape = f"{row.rows} x {row.columns}"
    return f"{1e3 * row.exposure_s:>7g} ms {shape:>9} {row.frames_per_node:>6}"


def _number_text(number: "Measured", unit: str = "") -> str:
    """Return a number with its unit and interval, or why it is unknown."""
    if number.value is None:
        return f"unknown: {number.why}"
    ends = "" if number.ci95 is None else f" (95 %: {number.ci95[0]:.3g} to {number.ci95[1]:.3g})"
    return f"{number.value:.3g}{' ' if unit else ''}{unit}{ends}"


def _cell(number: "Measured") -> str:
    """Return a number in a column."""
    return f"{'unknown' if number.value is None else format(number.value, '.3g'):>8}"


def _minutes(number: "Measured") -> str:
    """Return a duration in a column."""
    return f"{'unknown' if number.value is None else format(number.value / 60, '.1f') + ' min':>9}"
