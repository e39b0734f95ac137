"""Prediction of a capture by a rig.toml, and a table of others: exposures, grids, frames at a node."""

import math
import re
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from faintfield.calib.estimate import Estimate
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE
from faintfield.pipelines.formats.results.noise import NOISE_FILE
from faintfield.pipelines.formats.toml_files import read_rig
from faintfield.pipelines.planning.known import (
    KnownLens,
    KnownPace,
    Light,
    SeenSample,
    Sensor,
    calibration_file,
    fewest_seen,
    grid_centres_mm,
    known_lens,
    known_pace,
    known_sensor,
    pixel_share,
    planned_light,
    view_noise_e,
)
from faintfield.pipelines.planning.options import PlanOptions
from faintfield.pipelines.planning.prediction import (
    Alternative,
    DepthPrediction,
    FeaturePrediction,
    PredictionRecord,
    print_prediction,
)
from faintfield.recon.metrics import expected_snr_from_powers
from faintfield.recon.prediction import (
    depth_resolution_mm,
    depth_sigma_mm,
    information_of_views,
    sample_sigma_e,
    smallest_contrast,
)
from faintfield.rig.errors import KeepOutCrossed, OutsideTravel
from faintfield.rig.plan import MAX_EXPOSURE_S, CapturePlan, Grid, Until, centre_node, check_frame_count
from faintfield.rig.settings import RigSettings
from faintfield.rig.stages.protocol import Point

# Longest table; more rows are a typing error.
_MAX_ROWS = 500

_NO_BLUR = "nothing measures the lens's blur, none is assumed; --blur-px states it"
_NO_DEPTH = "no depth; give --depth-mm, or depth_mm under [scene] of the rig.toml"


type Array = NDArray[np.float64]


class View(NamedTuple):
    """Frames of a node, which add up to one view."""

    exposure_s: float
    frames: int

    def times(self, rounds: int) -> "View":
        """Return the frames of so many rounds."""
        return View(rounds * self.exposure_s, rounds * self.frames)


def predict_capture(rig: Path, options: PlanOptions) -> PredictionRecord:
    """Return and print what a capture by a rig.toml will show."""
    settings = read_rig(rig)
    sensor = known_sensor(
        settings,
        calibration_file(options.noise, NOISE_FILE, rig.parent),
        read_noise_e=options.read_noise_e,
        dark_current_e_per_s=options.dark_current_e_per_s,
        quantum_efficiency=options.quantum_efficiency,
    )
    lens = known_lens(settings, sensor, calibration_file(options.geometry, GEOMETRY_FILE, rig.parent), options.fx_px)
    exposure_s, view = scene_view(settings, options)
    depths_mm = options.depth_mm or settings.scene.depth_mm
    sides_px = [*(options.feature_px or []), *_in_px(options.feature_mm or [], depths_mm, lens.f_px)] or [10.0]
    grids = parse_grids(options.grids or [])
    light = planned_light(options, exposure_s, sensor)
    pace = known_pace(settings)
    predictor = Predictor(settings, options, sensor, lens, pace, light, exposure_s, view, depths_mm, sides_px, grids)
    record = predictor.record(str(rig))
    print_prediction(record)
    return record


def _in_px(sides_mm: list[float], depths_mm: Sequence[float], f_px: Estimate) -> list[float]:
    if not sides_mm:
        return []
    if not depths_mm or f_px.value is None:
        raise WrongUsage(
            f"--feature-mm {sides_mm[0]:g}: pixels of it are not known without a depth and a focal length; give "
            "--depth-mm and --fx-px or --geometry, or --feature-px"
        )
    return [side_mm * f_px.value / depths_mm[0] for side_mm in sides_mm]


def parse_grids(texts: Sequence[str]) -> list[tuple[int, int]]:
    """Return rows and columns of texts such as 5x7."""
    grids = []
    for text in texts:
        match = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", text, re.ASCII)
        if match is None:
            raise WrongUsage(f"--grids {text}: is no grid; give ROWSxCOLUMNS, such as 5x7")
        grids.append((int(match[1]), int(match[2])))
    return grids


def scene_view(settings: RigSettings, options: PlanOptions) -> tuple[float, View]:
    """Return the exposure of one frame of the dark scene, and the view that frames of a node and round add up to."""
    frames_s = [
        exposure_s
        for step in settings.steps()
        if step.kind == "dark_scene"
        for exposure_s in step.exposure_s * step.frames_per_node
    ] or [1e-3 * exposure_ms for exposure_ms in (options.exposures_ms or [])[:1]]
    if not frames_s:
        raise WrongUsage("the rig.toml has no dark_scene step; add one, or give --exposures-ms")
    return frames_s[0], View(sum(frames_s), len(frames_s))


@dataclass(frozen=True)
class Predictor:
    """Prediction from what is known of the rig and the scene; for the pace, a reason if it is not known.

    `exposure_s` is that of one frame of the dark scene, `view` the frames of a node in one round. `depths_mm` is empty
    if no depth is known, `grids` if only the rig's own is asked for.
    """

    settings: RigSettings
    options: PlanOptions
    sensor: Sensor
    lens: KnownLens
    pace: KnownPace | str
    light: Light
    exposure_s: float
    view: View
    depths_mm: Sequence[float]
    sides_px: Sequence[float]
    grids: Sequence[tuple[int, int]]

    @cached_property
    def pixel_share(self) -> float:
        """Part of the pixels that have the scarcest colour."""
        return pixel_share(self.settings, self.sensor)

    def record(self, rig: str) -> PredictionRecord:
        """Return the whole prediction."""
        grid, exposure_s, sigma_e = self.settings.grid, self.exposure_s, self.options.sigma_e
        view, rounds = self.whole_view, self.rounds
        rows = self._alternatives()
        reaching = [row for row in rows if _reaches(row, sigma_e)]
        return PredictionRecord(
            rig=rig,
            rows=grid.rows,
            columns=grid.columns,
            pitch_mm=grid.pitch_mm,
            exposure_s=exposure_s,
            total_exposure_s=view.exposure_s,
            frames_per_node=view.frames,
            noise_from=self.sensor.source,
            read_noise_e=self.sensor.read_noise_e,
            dark_current_e_per_s=self.sensor.dark_current_e_per_s,
            light_from=self.light.source,
            light_e=_with(lambda light: light * exposure_s, self.light.e_per_s),
            photons=_with(
                lambda light, qe: light * exposure_s / qe, self.light.e_per_s, self.sensor.quantum_efficiency
            ),
            pixel_share=self.pixel_share,
            snr=self._snr(view),
            snr_linear=_finite(self._from_light(view, _snr_linear)),
            vignetting=None if self.lens.response is not None else "no flats in the noise calibration",
            rose_k=self.options.rose_k,
            depths=[self._depth(depth_mm) for depth_mm in self.depths_mm or (None,)],
            time_s=self._duration(grid, rounds)[0],
            alternatives=rows,
            wanted_sigma_e=sigma_e,
            cheapest=min(reaching, key=lambda row: row.time_s.value or 0.0, default=None),
            until=self.until,
            rounds=rounds,
            reached_e=self._sigma(view, self._fewest(grid), exposure_s),
        )

    @property
    def until(self) -> Until | None:
        """When the dark scene needs no more rounds; None if it has no rounds."""
        return next((step.until for step in self.settings.step if step.until is not None), None)

    @cached_property
    def rounds(self) -> int:
        """Number of rounds that the dark scene will take."""
        return self._rounds(self.view, self._fewest(self.settings.grid), self.exposure_s)

    @cached_property
    def whole_view(self) -> View:
        """Frames of a node in all rounds."""
        return self.view.times(self.rounds)

    def _rounds(self, view: View, sample: SeenSample, exposure_s: float) -> int:
        """Return the number of rounds, of this view each, that reach the wanted noise; all if that is not known."""
        until = self.until
        if until is None:
            return 1

        def minus_sigma_e(rounds: int) -> float:
            sigma_e = self._sigma(view.times(rounds), sample, exposure_s).value
            return -math.inf if sigma_e is None else -sigma_e

        most = until.at_most_rounds
        return min(1 + bisect_left(range(1, most + 1), -until.sigma_e, key=minus_sigma_e), most)

    def _fewest(self, grid: Grid) -> SeenSample:
        """Return how the views see a sample at the depth that the fewest see."""
        return fewest_seen([self._views(grid, depth_mm)[1] for depth_mm in self.depths_mm or (None,)])

    def _from_light(self, view: View, compute: Callable[[float, float, float], float]) -> Estimate:
        """Return a number computed from light, dark electrons and read noise of a view, all in electrons."""

        def of_view(light_e_per_s: float, read_noise_e: float, dark_e_per_s: float) -> float:
            dark_e = max(dark_e_per_s, 0.0) * view.exposure_s
            noise_e = view_noise_e(read_noise_e, self.sensor.gain_dn_per_e.value, view.frames)
            return compute(light_e_per_s * view.exposure_s, dark_e, noise_e)

        return _with(of_view, self.light.e_per_s, self.sensor.read_noise_e, self.sensor.dark_current_e_per_s)

    def _snr(self, view: View) -> Estimate:
        return _finite(self._from_light(view, _snr_by_powers))

    def _depth(self, depth_mm: float | None) -> DepthPrediction:
        grid = self.settings.grid
        centres_mm, sample = self._views(grid, depth_mm)
        depth = Estimate(depth_mm) if depth_mm is not None else Estimate(None, why=_NO_DEPTH)
        scale = _with(lambda z, f: z / f, depth, self.lens.f_px)
        blur = Estimate(self.options.blur_px, why=_NO_BLUR if self.options.blur_px is None else None)
        aperture_mm = grid.pitch_mm * (max(grid.rows, grid.columns) - 1)
        step = Estimate(None, why="one node has no aperture")
        if aperture_mm > 0:
            step = _with(lambda z, f: depth_resolution_mm(z, f, aperture_mm), depth, self.lens.f_px)
        return DepthPrediction(
            depth_mm=depth_mm,
            views=int(np.count_nonzero(sample.response)),
            seen_by_all_mm=self._seen_by_all_mm(grid, scale.value),
            sigma_e=self._sigma(self.whole_view, sample),
            mm_per_px=scale,
            blur_mm=_with(lambda blur, mm: blur * mm, blur, scale),
            depth_step_mm=step,
            features=[self._feature(centres_mm, sample, side_px, depth) for side_px in self.sides_px],
        )

    def _feature(self, centres_mm: Array, sample: SeenSample, side_px: float, depth: Estimate) -> FeaturePrediction:
        contrast = self._contrast(self.whole_view, sample, side_px)
        unknown = next((quantity for quantity in (depth, self.lens.f_px) if quantity.value is None), None)
        if unknown is None and len(np.unique(centres_mm[sample.response > 0], axis=0)) < 2:
            unknown = Estimate(None, why="one view tells no depth")
        if unknown is None and contrast.value is not None and contrast.value > 1:
            unknown = Estimate(None, why="even a black square is not visible")

        def depth_sigma(light_e: float, information: Array) -> float:
            black = {"side_px": side_px, "difference_e": light_e, "blur_px": self.options.blur_px or 0.0}
            return depth_sigma_mm(depth.value or 0.0, self.lens.f_px.value or 0.0, centres_mm, information, **black)

        return FeaturePrediction(
            side_px=side_px,
            side_mm=_with(lambda z, f: side_px * (z / f), depth, self.lens.f_px),
            smallest_contrast=contrast,
            depth_sigma_mm=unknown or self._from_information(self.whole_view, sample, depth_sigma),
        )

    def _contrast(self, view: View, sample: SeenSample, side_px: float) -> Estimate:
        k, blur_px = self.options.rose_k, self.options.blur_px or 0.0

        def contrast(light_e: float, information: Array) -> float:
            return smallest_contrast(side_px, light_e, float(information.sum()), k=k, blur_px=blur_px)

        return self._from_information(view, sample, contrast)

    def _sigma(self, view: View, sample: SeenSample, exposure_s: float | None = None) -> Estimate:
        """Return σ of a sample in electrons of a view, or of an exposure."""
        unit = 1.0 if exposure_s is None else exposure_s / view.exposure_s

        def sigma(_: float, information: Array) -> float:
            return unit * sample_sigma_e(float(information.sum()), sample.spread)

        return self._from_information(view, sample, sigma)

    def _from_information(self, view: View, sample: SeenSample, compute: Callable[[float, Array], float]) -> Estimate:
        """Return a number computed from the light in electrons and the information of each view about a sample."""

        def of_view(light_e: float, dark_e: float, noise_e: float) -> float:
            return compute(light_e, self.pixel_share * information_of_views(light_e, dark_e, noise_e, sample.response))

        return self._from_light(view, of_view)

    def _views(self, grid: Grid, depth_mm: float | None) -> tuple[Array, SeenSample]:
        """Return the cameras' places (view, 2) relative to the reference camera, and how they see a sample."""
        centres_mm = grid_centres_mm(grid)
        return centres_mm, self.lens.sample(centres_mm, depth_mm)

    def _seen_by_all_mm(self, grid: Grid, mm_per_px: float | None) -> tuple[float, float] | None:
        if mm_per_px is None or self.lens.size_px is None:
            return None
        width, height = self.lens.size_px
        wide = width * mm_per_px - (grid.columns - 1) * grid.pitch_mm
        high = height * mm_per_px - (grid.rows - 1) * grid.pitch_mm
        return max(wide, 0.0), max(high, 0.0)

    def _alternatives(self) -> list[Alternative]:
        options, grid, view = self.options, self.settings.grid, self.view
        exposures_s = [1e-3 * exposure_ms for exposure_ms in options.exposures_ms or ()] or (self.exposure_s,)
        grids = self.grids or ((grid.rows, grid.columns),)
        alike = math.isclose(view.exposure_s, view.frames * self.exposure_s)
        frames = options.frames or (view.frames if alike else 1,)
        if (count := len(exposures_s) * len(grids) * len(frames)) > _MAX_ROWS:
            raise WrongUsage(f"the table has {count} rows, at most {_MAX_ROWS}; give fewer exposures, grids or frames")
        return [self._alternative(*row) for row in product(grids, exposures_s, frames)]

    def _alternative(self, shape: tuple[int, int], exposure_s: float, frames: int) -> Alternative:
        if not 0 < exposure_s <= MAX_EXPOSURE_S:
            raise WrongUsage(
                f"--exposures-ms {1e3 * exposure_s:g}: an exposure lasts {1e3 * MAX_EXPOSURE_S:g} ms at most; give "
                "shorter ones"
            )
        try:
            check_frame_count(shape[0] * shape[1] * frames)
            grid = _about_the_centre(self.settings.grid, shape)
            fewest, of_round = self._fewest(grid), View(frames * exposure_s, frames)
            # `until` counts in electrons of the exposure that it stands beside
            rounds = self._rounds(of_round, fewest, exposure_s)
            total_s, scene_s, why_not = self._duration(grid, rounds, (exposure_s, frames))
        except ValueError as failure:
            raise WrongUsage(str(failure)) from failure
        view = of_round.times(rounds)
        return Alternative(
            exposure_s=exposure_s,
            rows=shape[0],
            columns=shape[1],
            frames_per_node=frames,
            rounds=rounds,
            snr=self._snr(view),
            sigma_e=self._sigma(view, fewest, self.exposure_s),
            smallest_contrast=self._contrast(view, fewest, self.sides_px[0]),
            scene_s=scene_s,
            time_s=total_s,
            why_not=why_not,
        )

    def _duration(
        self, grid: Grid, rounds: int, frames: tuple[float, int] | None = None
    ) -> tuple[Estimate, Estimate, str | None]:
        """Return the duration of the session and of its dark scene, and why it cannot be done.

        `frames` are another exposure, and the number of frames at a node, of the dark scene.
        """
        settings, pace, steps = self.settings, self.pace, []
        for step in settings.steps():
            # The noise reference must be exposed like the dark scene
            if frames is not None and step.kind in ("dark_scene", "noise_reference"):
                step = replace(step, exposure_s=(frames[0],), frames_per_node=frames[1])
            if step.until is not None:
                step = replace(step, until=replace(step.until, at_most_rounds=rounds))
            steps.append(step)
        plan = CapturePlan.of(grid, steps, approach_mm=settings.stage.approach_mm, frame_bytes=0)
        if isinstance(pace, str):
            unknown = Estimate(None, why=pace)
            return unknown, unknown, None
        plan = replace(plan, settle_s=settings.settle.wait_s, readout_s=pace.readout_s)
        scene = replace(plan, steps=tuple(step for step in plan.steps if step.kind == "dark_scene"))
        whole, part = (Estimate(schedule.duration_s(pace.motion, pace.feed_mm_per_s)) for schedule in (plan, scene))
        try:
            pace.workspace.check_path(plan.path())
        except (OutsideTravel, KeepOutCrossed) as failure:
            return whole, part, str(failure)
        return whole, part, None


def _about_the_centre(grid: Grid, shape: tuple[int, int]) -> Grid:
    """Return a grid of other rows and columns, of the same pitch and with the same centre node."""
    rows, columns = shape
    row, column = centre_node(rows, columns)
    centre = grid.centre().target
    origin_mm = Point(centre.x_mm - column * grid.pitch_mm, centre.y_mm - row * grid.pitch_mm)
    return replace(grid, rows=rows, columns=columns, origin_mm=origin_mm)


def _reaches(row: Alternative, sigma_e: float | None) -> bool:
    """Test that a row reaches a σ, as far as is known, and can be done in a known time."""
    if sigma_e is None or row.sigma_e.value is None or row.time_s.value is None:
        return False
    return row.why_not is None and row.sigma_e.value <= sigma_e


def _snr_by_powers(light_e: float, dark_e: float, noise_e: float) -> float:
    return math.inf if dark_e == noise_e == 0 else expected_snr_from_powers(np.array([light_e]), dark_e, noise_e)


def _snr_linear(light_e: float, _: float, noise_e: float) -> float:
    return light_e / noise_e**2 if noise_e > 0 else math.inf


def _finite(snr: Estimate) -> Estimate:
    return Estimate(None, why="there is no noise to compare with") if snr.value == math.inf else snr


def _with(compute: Callable[..., float], first: Estimate, *further: Estimate) -> Estimate:
    """Return a number computed from others, with the interval that the first one's gives it; unknown if any is."""
    for estimate in (first, *further):
        if estimate.value is None:
            return estimate
    rest = [estimate.value for estimate in further]
    value = compute(first.value, *rest)
    if first.ci95 is None:
        return Estimate(value)
    low, high = sorted(compute(end, *rest) for end in first.ci95)
    return Estimate(value, ci95=(low, high))
