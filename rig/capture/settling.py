"""How long the rig swings after a move: found from short frames, once per session."""

from collections.abc import Callable

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.clock import Clock
from faintfield.rig.settings import SettleSettings

_LEAST_FRAMES = 6


class Settling(Struct, frozen=True):
    """What was found.

    Parameters
    ----------
    wait_s : float
        How long to rest before an exposure.
    settled : bool
        Whether the rig was seen to come to rest.
    scatter_px : float
        Of the shifts at rest: what noise alone makes.
    curve : tuple of (float, float)
        Time after the stop, and the shift from the picture at rest in pixels.
    """

    wait_s: float
    settled: bool
    scatter_px: float
    curve: tuple[tuple[float, float], ...]


def measure_settling(expose: Callable[[float], Pixels], clock: Clock, settings: SettleSettings) -> Settling:
    """Watch the rig right after a move.

    The mean of the last third of the frames is the picture r at rest. A small shift d changes a frame by ∇r · d, so d
    is the least-squares solution of ∇r · d = frame − r over all pixels.

    Parameters
    ----------
    expose : callable
        Takes a frame of an exposure time; what it returns is not kept.
    clock : Clock
        The rig's time.
    settings : SettleSettings
        For how long to watch, with which exposure, and which shift does no harm.
    """
    begun_s = clock.now_s()
    times_s: list[float] = []
    frames: list[Pixels] = []
    while clock.now_s() - begun_s < settings.longest_s or len(frames) < _LEAST_FRAMES:
        times_s.append(clock.now_s() - begun_s)
        frames.append(_smooth(expose(settings.exposure_s)))
    at_rest = len(frames) - len(frames) // 3
    shifts_px = _shifts_px(frames, np.mean(frames[at_rest:], axis=0))
    scatter_px = float(np.median(shifts_px[at_rest:]))
    swinging = np.flatnonzero(shifts_px > max(settings.limit_px, 4.0 * scatter_px))
    first_still = int(swinging[-1]) + 1 if len(swinging) else 0
    # In the dark shifts are noise, and a rig that swings to the end has no picture at rest
    settled = first_still <= at_rest and scatter_px <= settings.limit_px
    return Settling(
        wait_s=times_s[first_still] if settled else settings.longest_s,
        settled=settled,
        scatter_px=round(scatter_px, 5),
        curve=tuple((round(t, 4), round(float(shift), 4)) for t, shift in zip(times_s, shifts_px, strict=True)),
    )


def _smooth(pixels: Pixels) -> NDArray[np.float32]:
    """Return a frame in grey without its finest detail: noise has no gradient worth following."""
    grey = pixels if pixels.ndim == 2 else pixels.mean(axis=2)
    return np.asarray(cv2.GaussianBlur(np.asarray(grey, np.float32), (0, 0), 1.5), np.float32)


def _shifts_px(frames: list[Pixels], rest: Pixels) -> NDArray[np.float64]:
    """Return how far each frame is shifted from the picture at rest."""
    along_rows, along_columns = np.gradient(np.asarray(rest, float))
    gradients = np.stack([along_columns.ravel(), along_rows.ravel()])
    normal = gradients @ gradients.T + 1e-9 * np.eye(2)
    changes = np.stack([gradients @ (frame - rest).ravel() for frame in frames])
    return np.asarray(np.linalg.norm(np.linalg.solve(normal, changes.T), axis=0))
