"""Any call to the system may fail or kill: the command fails by name or succeeds, and then gives the same bytes."""

import signal
from collections.abc import Iterator

import numpy as np
import pytest

from faintfield.pipelines.formats.files import UNFINISHED
from faintfield.rig.session.verify import verify
from tests.faults.command_trials import COMMANDS, Bench, assert_survives, bench_in, faults_of
from tests.faults.io_faults import KINDS, Fault
from tests.patience import HANG_S

# Of the faults that can meet a command, every one of this many is tried: all would take hours. Primes: each kind of
# call is met by each of its two to four errors.
_STRIDE = {"capture": 7, "simulate": 7, "noise": 5, "geometry": 7, "reconstruct": 11, "run": 89}

# Full disk while a frame is written, a record is flushed, a name is given; a cable, a signal
_SMOKE = [
    *(Fault("write", "fail from then on", 4, "ENOSPC"), Fault("write", "cut short", 3, "ENOSPC")),
    *(
        Fault("sync", "fail once", 2, "EIO"),
        Fault("rename", "fail once", 1, "EIO"),
        Fault("read", "fail once", 3, "EIO"),
    ),
    Fault("write", "interrupt", 5),
]


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with bench_in(tmp_path_factory.mktemp("bench"), list(COMMANDS)) as bench:
        yield bench


@pytest.fixture(scope="session")
def small_bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with bench_in(tmp_path_factory.mktemp("bench"), ["capture", "reconstruct", "simulate"]) as bench:
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
    calls = small_bench.calls(name)
    assert_all_survived(small_bench, name, [fault for fault in _SMOKE if fault.nth <= calls.count(fault.kind)])


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
    numbers = [nth for nth, line in enumerate(of_kind, 1) if words in line and not line.endswith(UNFINISHED)]
    assert numbers
    return numbers


@pytest.mark.deep
@pytest.mark.parametrize("error", ["EACCES", "EIO"])
@pytest.mark.parametrize(
    ("kind", "words"),
    [("open", "/.parts/"), ("status", "/noise_reference.tiff"), ("list", "/out")],
    ids=["a colour that was just written", "a frame that a set may lack", "a folder of results"],
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


def assert_recovers_from_kills(bench: Bench, name: str, changing: int, others: int) -> None:
    """Assert that a command that is killed leaves nothing half-written, and ends well when it is run again."""
    for fault in kills(bench.calls(name), changing, others):
        bench.renew(name)
        outcome = bench.run(name, fault)
        assert outcome.ended.code == -signal.SIGKILL, f"{fault}: {outcome}"
        bench.assert_nothing_half_written(name, leftovers=True)
        bench.assert_ends_well(name)
        if name in ("noise", "geometry", "run"):
            assert verify(bench.folder(name) / "session").problems == ()


@pytest.mark.parametrize("name", ["capture", "reconstruct", "simulate"])
def test_killed_command_ends_well_when_run_again(small_bench: Bench, name: str) -> None:
    assert_recovers_from_kills(small_bench, name, changing=3, others=1)


@pytest.mark.deep
@pytest.mark.timeout(10 * HANG_S)
@pytest.mark.parametrize("name", ["capture", "simulate", "noise", "geometry", "run"])
def test_command_killed_at_many_instants(bench: Bench, name: str) -> None:
    assert_recovers_from_kills(bench, name, changing=40, others=10)
