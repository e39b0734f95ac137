"""Any call to the system may fail or kill: the command fails by name or succeeds, and then gives the same bytes."""

import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest

from faintfield.pipelines.formats.files import UNFINISHED
from faintfield.rig.session.verify import verify
from tests.faults.command_trials import COMMANDS, Bench, assert_survives, bench_in, faults_of
from tests.faults.io_faults import KINDS, TIME_OVER, Fault
from tests.patience import HANG_S

# Of the faults that can meet a command, every one of this many is tried: all would take hours. Primes: each kind of
# call is met by each of its two to four errors.
_STRIDE = {"capture": 7, "noise": 5, "geometry": 7, "reconstruct": 11, "run": 89}

# Full disk while a frame is written, a record is flushed, a name is given; a cable, a signal
_SMOKE = [
    *(Fault("write", "fail from then on", 4, "ENOSPC"), Fault("write", "cut short", 3, "ENOSPC")),
    *(
        Fault("sync", "fail once", 2, "EIO"),
        Fault("rename", "fail once", 1, "EIO"),
        Fault("read", "fail once", 3, "EIO"),
    ),
]


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with bench_in(tmp_path_factory.mktemp("bench"), list(COMMANDS)) as bench:
        yield bench


@pytest.fixture(scope="session")
def small_bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with bench_in(tmp_path_factory.mktemp("bench"), ["capture", "reconstruct"]) as bench:
        yield bench


def assert_all_survived(bench: Bench, name: str, faults: list[Fault]) -> None:
    """Try a command with each fault; name all those that it does not survive."""
    wrong, struck = {}, 0
    for fault in faults:
        try:
            struck += assert_survives(bench, name, fault)
        except AssertionError as failure:
            wrong[str(fault)] = str(failure)
    assert wrong == {}, f"{len(wrong)} of {len(faults)}"
    assert struck > 0.9 * len(faults)  # a run with different times may make a call less


@pytest.mark.parametrize("name", ["capture", "reconstruct"])
def test_command_survives_failing_calls(small_bench: Bench, name: str) -> None:
    assert_all_survived(small_bench, name, _SMOKE)


@pytest.mark.deep
@pytest.mark.timeout(10 * HANG_S)
@pytest.mark.parametrize("name", COMMANDS)
def test_command_survives_many_failing_calls(bench: Bench, name: str) -> None:
    assert_all_survived(bench, name, faults_of(bench.calls(name))[:: _STRIDE[name]])


def calls_on(bench: Bench, name: str, kind: str, words: str) -> list[int]:
    """Return which of the calls of a kind, counted from 1, an undisturbed run makes on files with these words."""
    bench.undisturbed(name)
    diary = bench.folder(name).with_suffix(".calls").read_text().splitlines()
    of_kind = [line for line in diary if line.split()[0] == str(KINDS.index(kind))]
    found = [nth for nth, line in enumerate(of_kind, 1) if words in line and not line.endswith(UNFINISHED)]
    assert found
    return found


@pytest.mark.deep
@pytest.mark.parametrize("error", ["EACCES", "EIO"])
@pytest.mark.parametrize(
    ("kind", "words"),
    [("open", "/.parts/"), ("status", "/noise_reference.tiff")],
    ids=["a colour that was just written", "a frame that a set may lack"],
)
def test_unreadable_file_is_not_taken_for_absent(bench: Bench, kind: str, words: str, error: str) -> None:
    for nth in calls_on(bench, "reconstruct", kind, words):
        assert_survives(bench, "reconstruct", Fault(kind, "fail once", nth, error))


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
