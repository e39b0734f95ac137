"""Measure frames while lights, boards and lens cap are still as they were: their quality, and how the rig settles."""

import math
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.clock import Clock
from faintfield.rig.plan import PlannedFrame, StepKind
from faintfield.rig.settings import BoardSettings, CheckSettings, SettleSettings

LIT_KINDS: frozenset[StepKind] = frozenset({"charuco", "bright", "flat"})
DARK_KINDS: frozenset[StepKind] = frozenset({"noise_reference", "dark"})
# A dark frame is divided into this many parts per axis to find stray light, and one of the scene to find its light.
PARTS = 8
# Boards are searched in an image reduced to this size in pixels: enough to see that they are in view, and fast.
_BOARD_SEARCH_PX = 1600
# Types of pixels that OpenCV knows.
_OPENCV_TYPES = ("uint8", "uint16", "float32", "float64")


class Quantity(Struct, frozen=True):
    """A measured quantity in words, with its unit; `digits` formats the value times `factor`.

    `warning` tells of a value beyond its limit, and what to do; without it such a value is no fault by itself.
    """

    label: str
    unit: str
    digits: str
    factor: float = 1.0
    warning: str | None = None

    def text(self, value: float) -> str:
        """Return a value in words.

        >>> QUANTITIES["saturated_share"].text(0.0123)
        '1.23 %'
        """
        return f"{value * self.factor:{self.digits}} {self.unit}".strip()


# The quantities that frames are checked for, by name, in the order in which they are shown.
QUANTITIES: dict[str, Quantity] = {
    "snr": Quantity("SNR of the brightest part", "", ".2f"),
    "stray_dn": Quantity("stray light since the darkest frame", "DN", "+.1f"),
    "leak_dn": Quantity(
        "difference of parts, by stray light",
        "DN",
        ".1f",
        warning="parts differ by {value:.1f} DN, limit {limit:g}; look for stray light",
    ),
    "board_corners": Quantity("board corners", "", "g"),
    "saturated_share": Quantity(
        "saturated pixels",
        "%",
        ".2f",
        100.0,
        "{value:.1%} of the pixels are saturated, limit {limit:.1%}; expose shorter",
    ),
    "contrast_dn": Quantity(
        "contrast", "DN", ".0f", warning="contrast {value:.0f} DN, limit {limit:.0f}; add light or expose longer"
    ),
    "sharpness": Quantity(
        "sharpness",
        "",
        ".3f",
        warning="sharpness {value:.3f}, limit {limit:.3f}; look for vibration or changed focus",
    ),
    "median_dn": Quantity(
        "median", "DN", ".0f", warning="median {value:.0f} DN, limit {limit:.0f}; light the diffuser or expose longer"
    ),
    "mean_dn": Quantity("mean", "DN", ".1f"),
    "darkest_dn": Quantity("mean of the darkest parts", "DN", ".1f"),
    "light_dn": Quantity("light of the brightest part", "DN", ".1f"),
}
# The quantities whose course over a step is shown, the main one first.
MAIN_QUANTITIES: dict[StepKind, tuple[str, ...]] = {
    "charuco": ("board_corners",),
    "bright": ("sharpness",),
    "dark_scene": ("snr", "stray_dn"),
    "noise_reference": ("leak_dn",),
    "dark": ("leak_dn",),
    "flat": ("median_dn",),
}


class Limit(Struct, frozen=True):
    """Smallest or largest value that a quantity may have."""

    value: float
    is_least: bool = False

    def holds(self, value: float) -> bool:
        """Return whether a value keeps the limit."""
        return value >= self.value if self.is_least else value <= self.value


class Findings(Struct, frozen=True):
    """Measured values of a frame, and their limits, by the names of `QUANTITIES`.

    `warnings` are one line each, with the limit and a remedy. `saturation_dn` is the value of a saturated pixel, None
    if it is not known. The values of the dark scene are explained at `_scene_values`.
    """

    values: dict[str, float]
    warnings: tuple[str, ...] = ()
    limits: dict[str, Limit] = {}
    saturation_dn: float | None = None


def check_frame(
    pixels: Pixels,
    kind: StepKind,
    limits: CheckSettings,
    boards: Sequence[BoardSettings] = (),
    earlier: Sequence[Mapping[str, float]] = (),
) -> Findings:
    """Measure a frame as its kind requires, and compare the values with the limits.

    `pixels` are (row, column) or (row, column, colour). Sharpness and stray light are compared with the values of
    `earlier` frames of the same step and exposure. Corners of boards are only counted: a warning depends on more than
    one frame, see `board_warnings`.
    """
    grey = _grey(pixels)
    # numpy sorts integers of at most 16 bits by radix, much faster than it finds their quantiles
    ordered_dn = np.sort(grey, axis=None, kind="stable" if grey.dtype.itemsize <= 2 else None)
    values: dict[str, float] = {"median_dn": _quantile(ordered_dn, 0.5)}
    largest_dn = float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind in "iu" else None
    saturation_dn = limits.saturation_dn or largest_dn
    if kind in LIT_KINDS:
        values["saturated_share"] = 0.0 if saturation_dn is None else float(np.mean(pixels >= saturation_dn))
    if kind in ("charuco", "bright"):
        values["contrast_dn"] = _quantile(ordered_dn, 0.99) - _quantile(ordered_dn, 0.01)
        values["sharpness"] = _sharpness(grey)
    if kind == "charuco":
        values["board_corners"] = float(_count_board_corners(grey, boards, _quantile(ordered_dn, 0.99)))
    if kind in DARK_KINDS:
        values["leak_dn"] = _leak_dn(grey)
    if kind == "dark_scene":
        values |= _scene_values(grey, earlier)
    kept = _limits(kind, limits, earlier)
    rounded = {name: round(value, 5) for name, value in values.items()}
    return Findings(rounded, _warnings(values, kept), kept, saturation_dn)


def mean_and_error(pixels: Pixels) -> tuple[float, float]:
    """Return the mean of a frame, and its standard error if the pixels differ by noise alone."""
    return float(pixels.mean(dtype=np.float64)), float(pixels.std(dtype=np.float64)) / math.sqrt(pixels.size)


def _grey(pixels: Pixels) -> Pixels:
    return pixels if pixels.ndim == 2 else pixels.mean(axis=2)


def _quantile(ordered: Pixels, share: float) -> float:
    """Return a quantile of values in ascending order: the mean of the two that it lies between."""
    place = share * (ordered.size - 1)
    return (float(ordered[math.floor(place)]) + float(ordered[math.ceil(place)])) / 2


def _sharpness(grey: Pixels) -> float:
    """Return the standard deviation of the Laplacian relative to that of the image.

    Every second row and column is used, so that the pattern of a colour mosaic does not count as detail.
    """
    samples = np.asarray(grey[::2, ::2], np.float32)
    contrast = float(samples.std())
    return float(cv2.Laplacian(samples, cv2.CV_32F).std()) / contrast if contrast else 0.0


def _leak_dn(grey: Pixels) -> float:
    """Return by how many DN the means of 8 x 8 parts of a frame differ, beyond the range expected from noise."""
    mean, sigma = _moments_of_parts(grey)
    # The expected range of 64 normal numbers is 4.7 standard deviations
    noise = 4.7 * float(np.median(sigma)) / np.sqrt((grey.shape[0] // PARTS) * (grey.shape[1] // PARTS))
    return max(0.0, float(np.ptp(mean) - noise))


def _scene_values(grey: Pixels, earlier: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return what a frame of the dark scene holds, by the brightest of its 8 x 8 parts and the darkest eighth of them.

    `snr` is eq. (4) of the paper, (<g²> − <n²>) / <n²>: g are the pixels of the brightest part above the mean of the
    darkest ones, n those of the darkest ones. `stray_dn` is how far this mean, `darkest_dn`, lies above the lowest of
    the step: light that came since. `light_dn` is how far the brightest part lies above the darkest ones; these are
    chosen by every other pair of rows and measured by the rest, as the choice favours noise.
    """
    mean, sigma = _moments_of_parts(grey)
    variance = sigma**2
    order = np.argsort(mean)
    darkest, brightest = order[: PARTS**2 // 8], order[-1]
    darkest_dn, noise_dn2 = float(mean[darkest].mean()), float(variance[darkest].mean())
    power_dn2 = float(variance[brightest] + (mean[brightest] - darkest_dn) ** 2)
    lowest_dn = min([darkest_dn, *(values["darkest_dn"] for values in earlier if "darkest_dn" in values)])
    values = {"darkest_dn": darkest_dn, "stray_dn": darkest_dn - lowest_dn}
    if len(grey) >= 4 * PARTS:
        chosen_rows = np.arange(len(grey)) // 2 % 2 == 0
        chosen_dn, measured_dn = (_moments_of_parts(grey[rows])[0] for rows in (chosen_rows, ~chosen_rows))
        order = np.argsort(chosen_dn)
        values["light_dn"] = float(measured_dn[order[-1]] - measured_dn[order[: PARTS**2 // 8]].mean())
    return {"snr": power_dn2 / noise_dn2 - 1, **values} if noise_dn2 else values


def _moments_of_parts(grey: Pixels) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean and standard deviation of the 8 x 8 parts of a frame, row by row."""
    native = np.asarray(grey, grey.dtype.newbyteorder("=") if grey.dtype.name in _OPENCV_TYPES else float)
    height, width = (length // PARTS for length in grey.shape)
    # One part at a time, without a copy of the frame as floats: that takes a quarter of numpy's time
    corners = [(row * height, column * width) for row in range(PARTS) for column in range(PARTS)]
    moments = [cv2.meanStdDev(native[row : row + height, column : column + width]) for row, column in corners]
    mean, sigma = np.array(moments, float).reshape(-1, 2).T
    return mean, sigma


def _count_board_corners(grey: Pixels, boards: Sequence[BoardSettings], white_dn: float) -> int:
    scale = min(1.0, _BOARD_SEARCH_PX / max(grey.shape))
    small = cv2.resize(np.asarray(grey, np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    picture = np.clip(small * (255.0 / max(white_dn, 1.0)), 0, 255).astype(np.uint8)
    count = 0
    for board in boards:
        corners = cv2.aruco.CharucoDetector(board.in_opencv()).detectBoard(picture)[0]
        count += 0 if corners is None else len(corners)
    return count


def _limits(kind: StepKind, settings: CheckSettings, earlier: Sequence[Mapping[str, float]]) -> dict[str, Limit]:
    limits = {}
    if kind in LIT_KINDS:
        limits["saturated_share"] = Limit(settings.saturated_share)
    if kind in ("charuco", "bright"):
        limits["contrast_dn"] = Limit(settings.least_contrast_dn, is_least=True)
        if sharpness := [of_frame["sharpness"] for of_frame in earlier if "sharpness" in of_frame]:
            limits["sharpness"] = Limit(settings.sharpness_share * float(np.median(sharpness)), is_least=True)
    if kind == "charuco":
        limits["board_corners"] = Limit(settings.board_corners, is_least=True)
    if kind == "flat":
        limits["median_dn"] = Limit(settings.least_flat_dn, is_least=True)
    if kind in DARK_KINDS:
        limits["leak_dn"] = Limit(settings.leak_dn)
    return limits


def _warnings(values: Mapping[str, float], limits: Mapping[str, Limit]) -> tuple[str, ...]:
    return tuple(
        quantity.warning.format(value=values[name], limit=limits[name].value)
        for name, quantity in QUANTITIES.items()
        if quantity.warning is not None and name in values and name in limits and not limits[name].holds(values[name])
    )


# If this many frames at the beginning of a sweep see no board, that is not due to the corner where the grid begins.
_FIRST_FRAMES = 3
# Largest tolerated share of a sweep's frames that see too little.
_MAX_POOR_SHARE = 0.5
# Number of nodes named in a warning.
_MAX_NAMED = 6


def board_warnings(
    last: PlannedFrame, frames: Sequence[PlannedFrame], corners: Mapping[int, int], limit: int
) -> tuple[str, ...]:
    """Return the warnings about boards that are due right after a frame, `last`, was taken.

    There is a warning when all of the first frames of a sweep show fewer than `limit` corners, when more than half of
    a sweep did, and when after all sweeps no board was seen from some node, so that its pose cannot be found. `corners`
    are the corners found, by the number of each frame taken.
    """
    boards = [frame for frame in frames if frame.kind == "charuco"]
    sweep = [frame for frame in boards if frame.step == last.step]
    counts = [corners[frame.number] for frame in sweep if frame.number in corners]
    poor = sum(count < limit for count in counts)
    warnings = []
    sweep_name = f"board sweep {last.sweep + 1}"
    if len(counts) == poor == min(_FIRST_FRAMES, len(sweep)):
        warnings.append(
            f"{sweep_name}: none of its first {poor} frames shows {limit} board corners, the most is {max(counts)}; "
            "move the board into view, or correct [[board]]"
        )
    elif len(counts) == len(sweep) and poor > _MAX_POOR_SHARE * len(counts):
        warnings.append(
            f"{sweep_name}: {poor} of {len(counts)} frames show fewer than {limit} board corners, limit half of them; "
            "stand the board nearer to the middle and take the sweep again, or add one"
        )
    if all(frame.number in corners for frame in boards):
        best: dict[tuple[int, int], int] = {}
        for frame in boards:
            best[frame.stop.node] = max(best.get(frame.stop.node, 0), corners[frame.number])
        blind = [list(node) for node, count in best.items() if count < limit]
        named = ", ".join(map(str, blind[:_MAX_NAMED])) + (" …" if len(blind) > _MAX_NAMED else "")
        if blind:
            warnings.append(
                f"{len(blind)} of {len(best)} nodes see {limit} board corners in no sweep ({named}), so that their "
                "poses cannot be found; add a sweep with a board in their view"
            )
    return tuple(warnings)


# Fewer leave the last third, which is taken as the picture at rest, a single frame.
_MIN_FRAMES = 6


class Settling(Struct, frozen=True):
    """Swing of the rig after a stop, as `measure_settling` saw it.

    The scatter is the median shift at rest, which is due to noise; the curve has the time in s after the stop, and the
    shift in pixels from the picture at rest.
    """

    scatter_px: float
    curve: tuple[tuple[float, float], ...]

    def rest_s(self, kind: StepKind, settings: SettleSettings) -> float | None:
        """Return the rest that a step needs after a move; None if the rig was not seen to come to rest."""
        limit_px = max(settings.limit_of(kind), 4.0 * self.scatter_px)
        swinging = [index for index, (_, shift_px) in enumerate(self.curve) if shift_px > limit_px]
        first_still = swinging[-1] + 1 if swinging else 0
        # In the dark, shifts are noise; a rig that swings to the end has no picture at rest
        seen = first_still <= _first_at_rest(len(self.curve)) and self.scatter_px <= settings.limit_px
        return self.curve[first_still][0] if seen else None


def _first_at_rest(frames: int) -> int:
    return frames - frames // 3


def measure_settling(expose: Callable[[float], Pixels], clock: Clock, settings: SettleSettings) -> Settling:
    """Measure how the rig swings; call it right after a move.

    The mean of the last third of the frames is the picture r at rest. A small shift d changes a frame by ∇r · d, so d
    is the least-squares solution of ∇r · d = frame − r over all pixels. `expose` takes and returns a frame, given its
    exposure time in s.
    """
    begun_s = clock.now_s()
    times_s: list[float] = []
    frames: list[Pixels] = []
    while clock.now_s() - begun_s < settings.longest_s or len(frames) < _MIN_FRAMES:
        times_s.append(clock.now_s() - begun_s)
        frames.append(_smooth(expose(settings.exposure_s)))
    at_rest = _first_at_rest(len(frames))
    shifts_px = _shifts_px(frames, np.mean(frames[at_rest:], axis=0))
    curve = tuple((round(t, 4), round(float(shift), 4)) for t, shift in zip(times_s, shifts_px, strict=True))
    return Settling(round(float(np.median(shifts_px[at_rest:])), 5), curve)


def _smooth(pixels: Pixels) -> NDArray[np.float32]:
    """Return a frame in grey, blurred a little, so that noise does not dominate the gradient."""
    return np.asarray(cv2.GaussianBlur(np.asarray(_grey(pixels), np.float32), (0, 0), 1.5), np.float32)


def _shifts_px(frames: list[Pixels], rest: Pixels) -> NDArray[np.float64]:
    along_rows, along_columns = np.gradient(np.asarray(rest, float))
    gradients = np.stack([along_columns.ravel(), along_rows.ravel()])
    normal = gradients @ gradients.T + 1e-9 * np.eye(2)
    changes = np.stack([gradients @ (frame - rest).ravel() for frame in frames])
    return np.asarray(np.linalg.norm(np.linalg.solve(normal, changes.T), axis=0))
