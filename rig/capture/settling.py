"""Measure from short frames how long the rig swings after a move."""

from collections.abc import Callable

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.clock import Clock
from faintfield.rig.settings import SettleSettings

# Fewer leave the last third, which is taken as the picture at rest, a single frame.
_MIN_FRAMES = 6


class Settling(Struct, frozen=True):
    """Result of `measure_settling`.

    Parameters
    ----------
    wait_s : float
        Rest in s before an exposure.
    settled : bool
        Whether the rig was seen at rest.
    scatter_px : float
        Median shift at rest in pixels, which is due to noise.
    curve : tuple of (float, float)
        Time in s after the stop, and shift in pixels from the picture at rest.
    """

    wait_s: float
    settled: bool
    scatter_px: float
    curve: tuple[tuple[float, float], ...]


def measure_settling(expose: Callable[[float], Pixels], clock: Clock, settings: SettleSettings) -> Settling:
    """Measure when the rig comes to rest; call it right after a move.

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
    at_rest = len(frames) - len(frames) // 3
    shifts_px = _shifts_px(frames, np.mean(frames[at_rest:], axis=0))
    scatter_px = float(np.median(shifts_px[at_rest:]))
    swinging = np.flatnonzero(shifts_px > max(settings.limit_px, 4.0 * scatter_px))
    first_still = int(swinging[-1]) + 1 if len(swinging) else 0
    # In the dark, shifts are noise; a rig that swings to the end has no picture at rest
    settled = first_still <= at_rest and scatter_px <= settings.limit_px
    return Settling(
        wait_s=times_s[first_still] if settled else settings.longest_s,
        settled=settled,
        scatter_px=round(scatter_px, 5),
        curve=tuple((round(t, 4), round(float(shift), 4)) for t, shift in zip(times_s, shifts_px, strict=True)),
    )


def _smooth(pixels: Pixels) -> NDArray[np.float32]:
    """Return a frame in grey, blurred a little, so that noise does not dominate the gradient."""
    grey = pixels if pixels.ndim == 2 else pixels.mean(axis=2)
    return np.asarray(cv2.GaussianBlur(np.asarray(grey, np.float32), (0, 0), 1.5), np.float32)


def _shifts_px(frames: list[Pixels], rest: Pixels) -> NDArray[np.float64]:
    along_rows, along_columns = np.gradient(np.asarray(rest, float))
    gradients = np.stack([along_columns.ravel(), along_rows.ravel()])
    normal = gradients @ gradients.T + 1e-9 * np.eye(2)
    changes = np.stack([gradients @ (frame - rest).ravel() for frame in frames])
    return np.asarray(np.linalg.norm(np.linalg.solve(normal, changes.T), axis=0))
