"""Frames whose exposure began before their request are refused, whichever of the two clocks shows it."""

import pytest

from faintfield.rig.cameras.aravis_frames import FrameTimes, Moment, Stamps
from faintfield.rig.errors import CameraError

S = 1_000_000_000
DATE = 1_700_000_000 * S
CAMERA = 77 * S  # what the camera's clock shows when the computer's shows 0


class World:
    """A camera that begins its exposure when it is told, on a clock that runs faster by `rate`."""

    def __init__(self, exposure_s: float = 1.0, rate: float = 0.0, stamps_end: bool = False) -> None:
        self.exposure_s = exposure_s
        self.rate = rate
        self.stamps_end = stamps_end
        self.times = FrameTimes()

    def check(self, requested_s: float, began_s: float, held_s: float = 0.0, jump_s: float = 0.0) -> None:
        """Check a frame that began at `began_s`, and was held up by `held_s` on its way."""
        received_s = began_s + self.exposure_s + 0.02 + held_s
        stamped_s = began_s + (self.exposure_s if self.stamps_end else 0.0)
        stamps = Stamps(DATE + round(S * received_s), CAMERA + round(S * stamped_s * (1.0 + self.rate)))
        now_s = received_s + 0.001
        requested = Moment(round(S * requested_s), DATE + round(S * requested_s))
        now = Moment(round(S * now_s), DATE + round(S * (now_s + jump_s)))
        self.times.check(stamps, requested, now, self.exposure_s)


@pytest.mark.parametrize("stamps_end", [False, True])
@pytest.mark.parametrize("rate", [-1e-4, 1e-4])
def test_frames_begun_after_their_request_are_accepted(rate: float, stamps_end: bool) -> None:
    world = World(rate=rate, stamps_end=stamps_end)
    for requested_s, latency_s in ((10.0, 0.0), (12.0, 0.3), (14.0, 0.0), (5000.0, 0.0), (5002.0, 0.0)):
        world.check(requested_s, requested_s + latency_s, held_s=2.0 * latency_s)


def test_frame_sooner_than_its_exposure_is_refused() -> None:
    world = World()
    world.check(10.0, 9.95)  # within what exposures differ by
    with pytest.raises(CameraError, match=r"came 720\.0 ms after it was requested, sooner than its exposure of 1 s"):
        world.check(20.0, 19.7)


@pytest.mark.parametrize("stamps_end", [False, True])
def test_frame_held_back_is_refused_by_its_clock(stamps_end: bool) -> None:
    world = World(stamps_end=stamps_end)
    world.check(10.0, 10.0)
    with pytest.raises(CameraError, match="too old by the camera's clock: its exposure began before the request"):
        world.check(20.0, 19.5, held_s=0.6)
    world.check(21.0, 21.0)


def test_frame_that_came_twice_is_refused() -> None:
    world = World()
    world.check(10.0, 10.0)
    with pytest.raises(CameraError, match="not newer by the camera's clock"):
        world.check(20.0, 10.0, held_s=10.5)
    world.exposure_s = 0.5
    with pytest.raises(CameraError, match="not newer by the camera's clock"):
        world.check(20.0, 9.0, held_s=11.5)


@pytest.mark.parametrize("jump_s", [-1.0, 0.5])
def test_jump_of_the_date_is_refused(jump_s: float) -> None:
    world = World()
    with pytest.raises(CameraError, match=r"date jumped by [+-]\d+\.\d+ s during the exposure"):
        world.check(10.0, 10.0, jump_s=jump_s)


def test_slow_or_earlier_correction_of_date_is_harmless() -> None:
    world = World(exposure_s=30.0)
    world.check(10.0, 10.0, jump_s=0.02)
    later = Moment(100 * S, DATE + 100 * S - 3600 * S)
    stamps = Stamps(later.date_ns + round(30.02 * S), CAMERA + 100 * S)
    world.times.check(stamps, later, Moment(131 * S, later.date_ns + 31 * S), 30.0)


def test_camera_without_a_clock() -> None:
    times = FrameTimes()
    for second in (10, 20):
        requested = Moment(second * S, DATE + second * S + 999)
        received_ns = (DATE + second * S) // 1000 * 1000  # the same microsecond
        times.check(Stamps(received_ns, 0), requested, requested, 0.0)
        with pytest.raises(CameraError, match="began before the request"):
            times.check(Stamps(received_ns - 1000, 0), requested, requested, 0.0)
