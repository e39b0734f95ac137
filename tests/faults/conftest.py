"""The benches on which commands are tried, made once: that takes longer than any trial."""

from collections.abc import Iterator

import pytest

from tests.faults.command_trials import COMMANDS, Bench, bench_in


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Return a bench for all commands, for deep tests."""
    with bench_in(tmp_path_factory.mktemp("bench"), list(COMMANDS)) as bench:
        yield bench


@pytest.fixture(scope="session")
def small_bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with bench_in(tmp_path_factory.mktemp("bench"), ["capture", "reconstruct"]) as bench:
        yield bench
