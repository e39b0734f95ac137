"""Kill commands at any instant: run again, they end with the results of an undisturbed run."""

import signal
import time

import numpy as np
import pytest

from faintfield.rig.session.verify import verify
from tests.faults.command_trials import Bench
from tests.faults.io_faults import TIME_OVER, Fault
from tests.patience import HANG_S

_CHANGING = {"create", "write", "sync", "rename", "remove", "make", "allocate"}


def kills(calls: list[str], changing: int, others: int) -> list[Fault]:
    """Return kills at calls that change a file, and at any others, evenly spread from the first to the last."""
    places = [index for index, kind in enumerate(calls) if kind in _CHANGING]
    rest = [index for index, kind in enumerate(calls) if kind not in _CHANGING]
    chosen = {
        of[int(at)]
        for of, count in ((places, changing), (rest, others))
        for at in np.unique(np.linspace(0, len(of) - 1, count).round())
    }
    return [Fault(calls[index], "kill", calls[: index + 1].count(calls[index])) for index in sorted(chosen)]


def assert_recovers(bench: Bench, name: str) -> None:
    """Assert that a command that was killed left nothing half-written, and ends well if it is run again."""
    bench.assert_nothing_half_written(name, leftovers=True)
    again = bench.run(name)
    assert again.code == 0, again.complaint
    bench.assert_finished(name)
    if name != "reconstruct":
        assert verify(bench.folder(name) / "session").problems == ()


def assert_recovers_from_all(bench: Bench, name: str, faults: list[Fault]) -> None:
    for fault in faults:
        bench.renew(name)
        ended = bench.run(name, fault)
        assert ended.code == -signal.SIGKILL, f"{fault}: {ended}"
        assert_recovers(bench, name)


def test_killed_command_ends_well_when_run_again(small_bench: Bench) -> None:
    faults = kills(small_bench.calls("reconstruct"), changing=4, others=1)
    assert_recovers_from_all(small_bench, "reconstruct", faults)


@pytest.mark.deep
@pytest.mark.timeout(10 * HANG_S)
@pytest.mark.parametrize("name", ["noise", "geometry", "run"])
def test_command_killed_at_many_instants(bench: Bench, name: str) -> None:
    faults = kills(bench.calls(name), changing=40, others=10)
    assert_recovers_from_all(bench, name, faults)
    bench.renew(name)
    begun_s = time.monotonic()
    assert bench.run(name).code == 0
    whole_s = time.monotonic() - begun_s
    for share in np.random.default_rng(16).uniform(0.0, 1.0, 10):
        bench.renew(name)
        ended = bench.run(name, limit_s=float(share) * whole_s)
        assert ended.code in (TIME_OVER, 0)
        assert_recovers(bench, name)
