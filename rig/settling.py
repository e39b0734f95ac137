"""How long the rig swings after a move: found from short frames, once per session."""

from collections.abc import Callable

import numpy as np
from msgspec import Struct

from rig.cameras.protocol import Pixels
from rig.clock import Clock
from rig.settings import SettleSettings

# Frames at rest differ from one another by noise; those that differ by this much more show a swing.
_EXCESS = 1.5
_LEAST_FRAMES = 6


class Settling(Struct, frozen=True):
    """What was found.

    Parameters
    ----------
    wait_s : float
        How long to rest before an exposure.
    settled : bool
        Whether the rig came to rest while it was watched.
    curve : tuple of (float, float)
        Time after the stop, and the rms difference from the rig at rest in units of the noise.
    """

    wait_s: float
    settled: bool
    curve: tuple[tuple[float, float], ...]


def measure_settling(expose: Callable[[float], Pixels], clock: Clock, settings: SettleSettings) -> Settling:
    """Watch the rig right after a move.

    The last third of the frames stands for the rig at rest. A frame taken earlier shows a swing when it differs from
    their mean by more than they do themselves.

    Parameters
    ----------
    expose : callable
        Takes a frame of an exposure time; what it returns is not kept.
    clock : Clock
        The rig's time.
    settings : SettleSettings
        For how long to watch, and with which exposure.
    """
    begun_s = clock.now_s()
    times_s: list[float] = []
    frames: list[Pixels] = []
    while clock.now_s() - begun_s < settings.longest_s or len(frames) < _LEAST_FRAMES:
        times_s.append(clock.now_s() - begun_s)
        frames.append(np.asarray(expose(settings.exposure_s), np.float32))
    at_rest = len(frames) - len(frames) // 3
    rest = np.mean(frames[at_rest:], axis=0)
    differences = np.array([np.sqrt(np.mean(np.square(frame - rest))) for frame in frames])
    noise = max(float(np.median(differences[at_rest:])), 1e-6)
    swinging = np.flatnonzero(differences > _EXCESS * noise)
    first_still = int(swinging[-1]) + 1 if len(swinging) else 0
    settled = first_still <= at_rest
    return Settling(
        wait_s=times_s[first_still] if settled else settings.longest_s,
        settled=settled,
        curve=tuple((round(t, 4), round(float(d) / noise, 3)) for t, d in zip(times_s, differences, strict=True)),
    )
