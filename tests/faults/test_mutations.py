"""No input gives a traceback, a hang, memory without bound, or a touch outside its folder."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.faults.mutation_kinds import KINDS, in_force
from tests.faults.mutations import CASES, ONE_THREAD

_ROOT = Path(__file__).parents[2]
_KEPT = [json.loads(line) for line in CASES.read_text().splitlines()]

# Seeds of `make campaigns`, which repeat none of those of `make test`.
_FIRST_OF_MANY = 10_000

# For a machine that does much else.
_MAX_SECONDS = 3600

pytestmark = pytest.mark.timeout(_MAX_SECONDS)

type Ask = Callable[..., list[str]]

KINDS_HERE = [
    pytest.param(kind, marks=() if in_force(kind) else pytest.mark.skip(reason="needs FAINTFIELD_DATA"))
    for kind in KINDS
]

BROKEN = {
    "traceback": "traceback: KeyError: 'planes'",
    "hang": "hang: waited too long",
    "endless_loop": "hang: ran too long",
    "hanging_thread": "hang: waited too long",
    "crash": "died by signal SIGSEGV",
    "much_memory": "traceback: numpy",
    "other_exit_code": "exit code 3",
    "silent_failure": "exit code 1 without one line of failure",
    "two_lines_of_failure": "exit code 1 without one line of failure",
    "failure_that_succeeds": "exit code 0 after a failure",
    "forged_line": "a name made a line of its own",
    "control_character": "the control character '\\x1b' reached the terminal",
    "python_warning": "a warning of Python",
    "writes_outside": "outside its folder: 'beside/new.txt' was made",
    "overwrites_another": "outside its folder: 'victim.txt' was changed",
    "removes_an_input": "outside its folder: 'IN/elemental.toml' was removed",
    "leaves_unfinished": "half-written: 'OUT/.plane.tiff.ab12.unfinished' was left",
    "half_a_record": "half-written: 'OUT/reconstruction.json' is no JSON",
    "script_in_page": "half-written: 'OUT/report.html' holds a script that came in a name",
    "leaves_a_process": "left a process running",
}


@pytest.fixture(scope="session")
def ask(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ask]:
    """Send a request to a process without threads that runs mutations, and return the faults that it found."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    server = subprocess.Popen(
        [sys.executable, "-m", "tests.faults.mutations", "--serve", str(shared / "mutations")],
        cwd=_ROOT,
        env=os.environ | ONE_THREAD,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert server.stdin is not None
    assert server.stdout is not None

    def request(**words: Any) -> list[str]:
        server.stdin.write(json.dumps(words) + "\n")  # type: ignore[union-attr]
        server.stdin.flush()  # type: ignore[union-attr]
        answer = server.stdout.readline()  # type: ignore[union-attr]
        assert answer, "the process that runs mutations ended"
        found: list[str] = json.loads(answer)
        return found

    yield request
    server.stdin.close()
    server.stdout.close()
    server.wait()


@pytest.mark.parametrize("kind", KINDS_HERE)
def test_every_command_reads_the_files_before_they_are_mutated(kind: str, ask: Ask) -> None:
    for call in KINDS[kind].calls:
        assert ask(kind=kind, call=call.words, edits=[]) == []


@pytest.mark.parametrize("kind", KINDS_HERE)
def test_mutated_files_are_read_or_refused_in_one_line(kind: str, ask: Ask) -> None:
    found = ask(kind=kind, first=0, last=KINDS[kind].usual)
    assert not found, "\n".join(found)


@pytest.mark.campaign
@pytest.mark.parametrize("kind", KINDS_HERE)
def test_many_mutated_files_are_read_or_refused_in_one_line(kind: str, ask: Ask) -> None:
    found = ask(kind=kind, first=_FIRST_OF_MANY, last=_FIRST_OF_MANY + KINDS[kind].many)
    assert not found, "\n".join(found)


@pytest.mark.parametrize("case", _KEPT, ids=[case["name"] for case in _KEPT])
def test_what_was_found_once_stays_mended(case: dict[str, Any], ask: Ask) -> None:
    assert ask(kind=case["kind"], call=case["call"], edits=case["edits"]) == []


@pytest.mark.parametrize("function", BROKEN)
def test_a_command_that_misbehaves_is_found_out(function: str, ask: Ask) -> None:
    found = ask(
        function=f"tests.faults.broken_commands:{function}",
        seconds=2.0 if BROKEN[function].startswith("hang") else 60.0,
    )
    assert [it for it in found if it.startswith(BROKEN[function])], found


@pytest.mark.parametrize("function", ["well_behaved", "well_refused"])
def test_a_command_that_behaves_is_not_blamed(function: str, ask: Ask) -> None:
    assert ask(function=f"tests.faults.broken_commands:{function}", seconds=60.0) == []
