"""Any call to the system may fail: the command fails by name or succeeds, and afterwards gives the same bytes."""

from collections.abc import Iterator

import numpy as np
import pytest

from tests.faults.command_trials import COMMANDS, Bench, assert_survives, bench_in, faults_of
from tests.faults.io_faults import Fault
from tests.patience import HANG_S

# How many trials `make test` makes of each command; the longer it takes, the fewer.
_SAMPLE = {"capture": 20, "noise": 15, "geometry": 15, "reconstruct": 12, "run": 6}

# Of the faults that can meet a command, the slow test takes every one of this many: 1 would take hours.
_STRIDE = {"capture": 7, "noise": 4, "geometry": 7, "reconstruct": 11, "run": 90}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with bench_in(tmp_path_factory.mktemp("io")) as opened:
        yield opened


def assert_all_survived(bench: Bench, name: str, faults: list[Fault]) -> None:
    """Try a command with each fault; name all those that it does not survive."""
    wrong = {}
    for fault in faults:
        try:
            assert_survives(bench, name, fault)
        except AssertionError as failure:
            wrong[str(fault)] = str(failure)
    assert wrong == {}, f"{len(wrong)} of {len(faults)}"


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_survives_faults_of_the_system(bench: Bench, name: str) -> None:
    faults = faults_of(bench.calls(name))
    chosen = np.random.default_rng(15).choice(len(faults), _SAMPLE[name], replace=False)
    assert_all_survived(bench, name, [faults[index] for index in sorted(chosen)])


@pytest.mark.slow
@pytest.mark.timeout(HANG_S)
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_survives_many_faults_of_the_system(bench: Bench, name: str) -> None:
    assert_all_survived(bench, name, faults_of(bench.calls(name))[:: _STRIDE[name]])
