"""The bench on which commands are tried, made once: it takes longer than any trial."""

from collections.abc import Iterator

import pytest

from tests.faults.command_trials import Bench, bench_in


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with bench_in(tmp_path_factory.mktemp("bench")) as opened:
        yield opened
