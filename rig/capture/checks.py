"""Is the frame just taken any good? Looked at while the lights, boards and lens cap are still as they were."""

from collections.abc import Sequence

import cv2
import numpy as np
from msgspec import Struct

from faintfield.rig.boards import BoardSettings
from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.plan import StepKind
from faintfield.rig.settings import CheckSettings

LIT: frozenset[StepKind] = frozenset({"charuco", "bright", "flat"})
UNLIT: frozenset[StepKind] = frozenset({"noise_reference", "dark"})
_BLOCKS = 8
# Boards are looked for in a reduced picture: enough to see that they are in view, and quick.
_LOOK_PX = 1600


class Findings(Struct, frozen=True):
    """What was measured in a frame, and what is wrong with it.

    Parameters
    ----------
    values : dict
        By name: `median_dn`, `contrast_dn`, `saturated_share`, `sharpness`, `board_corners`, `leak_dn`.
    warnings : tuple of str
        One line each, with the limit and what to do.
    """

    values: dict[str, float]
    warnings: tuple[str, ...]


def check_frame(
    pixels: Pixels,
    kind: StepKind,
    limits: CheckSettings,
    boards: Sequence[BoardSettings] = (),
    earlier_sharpness: Sequence[float] = (),
) -> Findings:
    """Measure what matters in a frame of this kind; of boards `rig.capture.sweeps` judges, by more than one frame.

    Parameters
    ----------
    pixels : array
        (row, column) or (row, column, colour).
    kind : str
        What the frame is for.
    limits : CheckSettings
        From where on to warn.
    boards : sequence of BoardSettings
        What a charuco frame should show.
    earlier_sharpness : sequence of float
        Of the frames of the same step.
    """
    values: dict[str, float] = {"median_dn": float(np.median(pixels))}
    grey = pixels if pixels.ndim == 2 else pixels.mean(axis=2)
    if kind in LIT:
        values["saturated_share"] = saturated_share(pixels, limits.saturation_dn)
    if kind in ("charuco", "bright"):
        values["contrast_dn"] = float(np.subtract(*np.quantile(grey, (0.99, 0.01))))
        values["sharpness"] = sharpness(grey)
    if kind == "charuco":
        values["board_corners"] = float(board_corners(grey, boards))
    if kind in UNLIT:
        values["leak_dn"] = leak_dn(grey)
    return Findings(
        {name: round(value, 5) for name, value in values.items()}, _judge(kind, values, limits, earlier_sharpness)
    )


def saturated_share(pixels: Pixels, saturation_dn: float | None) -> float:
    """Return the share of pixels at or above saturation."""
    most = saturation_dn or (np.iinfo(pixels.dtype).max if pixels.dtype.kind in "iu" else np.inf)
    return float(np.mean(pixels >= most))


def sharpness(grey: Pixels) -> float:
    """Return the rms second difference relative to the contrast, of every second pixel: a mosaic is no detail."""
    samples = np.asarray(grey[::2, ::2], np.float32)
    contrast = float(samples.std())
    return float(cv2.Laplacian(samples, cv2.CV_32F).std()) / contrast if contrast else 0.0


def leak_dn(grey: Pixels) -> float:
    """Return by how much parts of a frame differ, beyond what noise makes of 8 x 8 means."""
    height, width = (length // _BLOCKS for length in grey.shape)
    parts = np.asarray(grey[: height * _BLOCKS, : width * _BLOCKS], float).reshape(_BLOCKS, height, _BLOCKS, width)
    # The mean of 64 normal numbers' ranges is 4.7 of their standard deviations
    noise = 4.7 * float(np.median(parts.std(axis=(1, 3)))) / np.sqrt(height * width)
    return max(0.0, float(np.ptp(parts.mean(axis=(1, 3))) - noise))


def board_corners(grey: Pixels, boards: Sequence[BoardSettings]) -> int:
    """Return how many corners of the boards are found."""
    white = max(float(np.quantile(grey, 0.99)), 1.0)
    scale = min(1.0, _LOOK_PX / max(grey.shape))
    small = cv2.resize(np.asarray(grey, np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    picture = np.clip(small * (255.0 / white), 0, 255).astype(np.uint8)
    found = 0
    for board in boards:
        corners = cv2.aruco.CharucoDetector(board.in_opencv()).detectBoard(picture)[0]
        found += 0 if corners is None else len(corners)
    return found


def _judge(
    kind: StepKind, values: dict[str, float], limits: CheckSettings, earlier_sharpness: Sequence[float]
) -> tuple[str, ...]:
    """Return the warnings."""
    warnings = []
    share = values.get("saturated_share", 0.0)
    if share > limits.saturated_share:
        warnings.append(f"{share:.1%} of the pixels are saturated, limit {limits.saturated_share:.1%}; expose shorter")
    if values.get("contrast_dn", np.inf) < limits.least_contrast_dn:
        warnings.append(
            f"contrast {values['contrast_dn']:.0f} DN, limit {limits.least_contrast_dn:.0f}; "
            "turn the light on or expose longer"
        )
    if kind == "flat" and values["median_dn"] < limits.least_flat_dn:
        warnings.append(
            f"median {values['median_dn']:.0f} DN, limit {limits.least_flat_dn:.0f}; "
            "light the diffuser or expose longer"
        )
    if earlier_sharpness and values.get("sharpness", np.inf) < (
        least := limits.sharpness_share * float(np.median(earlier_sharpness))
    ):
        warnings.append(f"sharpness {values['sharpness']:.3f}, limit {least:.3f}; look for a swing or a touched focus")
    if values.get("leak_dn", 0.0) > limits.leak_dn:
        warnings.append(
            f"parts differ by {values['leak_dn']:.1f} DN in the dark, limit {limits.leak_dn:g}; look for stray light"
        )
    return tuple(warnings)
