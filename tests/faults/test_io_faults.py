"""Any call to the system may fail: the command fails by name or succeeds, and afterwards gives the same bytes."""

import pytest

from faintfield.pipelines.formats.files import UNFINISHED
from tests.faults.command_trials import COMMANDS, Bench, assert_survives, faults_of
from tests.faults.io_faults import KINDS, Fault
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
