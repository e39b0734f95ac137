"""The wrong changes are those that they claim to be, and the list of harmless ones is up to date."""

import ast

import pytest

from tests.mutants.__main__ import equivalent, wilson
from tests.mutants.changes import mutants_of, mutated
from tests.mutants.judge import ROOT

_SOURCE = '''"""Text."""
import math
LIMIT = 20

def largest(values: list[int], start: int = 1) -> int:
    """Return the largest."""
    found = start
    for value in values:
        if value < LIMIT and value > found:
            found = value
        else:
            continue
    if not values:
        raise ValueError(f"{LIMIT + 1} values are too many; give fewer")
    return found
'''
_EXPECTED = {
    ("(module)", "LIMIT = 40"),
    ("(module)", "LIMIT = 0"),
    ("largest", "def largest(values: list[int], start: int=2) -> int:"),
    ("largest", "def largest(values: list[int], start: int=0) -> int:"),
    ("largest", "if value < LIMIT or value > found:"),
    ("largest", "if value < LIMIT:"),
    ("largest", "if value > found:"),
    ("largest", "if not (value < LIMIT and value > found):"),
    ("largest", "if value <= LIMIT and value > found:"),
    ("largest", "if value >= LIMIT and value > found:"),
    ("largest", "if value < LIMIT and value >= found:"),
    ("largest", "if value < LIMIT and value <= found:"),
    ("largest", "pass"),
    ("largest", "break"),
    ("largest", "if values:"),
    ("largest", "if False:"),
    ("largest", "raise Exception('…')"),
    ("largest", "return -found"),
}


def test_each_operator_makes_its_changes_and_no_other() -> None:
    found = mutants_of("file.py", _SOURCE)
    assert {(it.name.split(":")[0].split()[1], it.name.partition(" ⇒ ")[2]) for it in found} == _EXPECTED
    assert len({mutant.name for mutant in found}) == len(found)


def test_a_mutant_differs_from_the_source_in_what_its_name_says() -> None:
    unchanged = ast.unparse(ast.parse(_SOURCE)).splitlines()
    for mutant in mutants_of("file.py", _SOURCE):
        lines = mutated(_SOURCE, mutant.place).splitlines()
        (different,) = (k for k, pair in enumerate(zip(unchanged, lines, strict=True)) if pair[0] != pair[1])
        after = mutant.name.partition(" ⇒ ")[2].partition("…")[0].removesuffix(" (2)")
        assert lines[different].strip().replace('f"', "'").startswith(after.strip("'(")) or "…" in mutant.name


def test_the_lines_of_a_mutant_are_those_of_its_statement_without_its_block() -> None:
    lines = {mutant.name.partition(" ⇒ ")[2]: mutant.lines for mutant in mutants_of("file.py", _SOURCE)}
    assert lines["LIMIT = 40"] == range(0)
    assert lines["def largest(values: list[int], start: int=2) -> int:"] == range(0)
    assert lines["if value < LIMIT:"] == range(9, 10)
    assert lines["return -found"] == range(15, 16)


@pytest.mark.parametrize(("found", "total", "interval"), [(45, 50, (0.786, 0.957)), (0, 10, (0.0, 0.278))])
def test_intervals_of_shares_are_wilsons(found: int, total: int, interval: tuple[float, float]) -> None:
    assert wilson(found, total) == pytest.approx(interval, abs=5e-4)


def test_every_mutant_that_is_left_out_exists_and_has_a_reason() -> None:
    kept = equivalent()
    present = {
        mutant.name
        for file in {name.partition(" ")[0] for name in kept}
        for mutant in mutants_of(file, (ROOT / file).read_text())
    }
    assert kept.keys() - present == set()
    assert all(len(why.split()) >= 4 for why in kept.values())
