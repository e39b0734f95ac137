"""The wrong changes are those that their names say."""

import ast

from tests.mutants.changes import mutants_of, mutated

_SOURCE = '''"""Text."""
import math
LIMIT = 20

def largest(values: list[int], start: int = 1) -> int:
    """Return the largest."""
    most = start
    for value in values:
        if value < LIMIT and value > most:
            most = value
        else:
            continue
    if not values:
        raise ValueError(f"{LIMIT + 1} values are too many; give fewer")
    return most
'''
_EXPECTED = {
    ("(module)", "LIMIT = 40"),
    ("(module)", "LIMIT = 0"),
    ("largest", "def largest(values: list[int], start: int=2) -> int:"),
    ("largest", "def largest(values: list[int], start: int=0) -> int:"),
    ("largest", "if value < LIMIT or value > most:"),
    ("largest", "if value < LIMIT:"),
    ("largest", "if value > most:"),
    ("largest", "if not (value < LIMIT and value > most):"),
    ("largest", "if value <= LIMIT and value > most:"),
    ("largest", "if value >= LIMIT and value > most:"),
    ("largest", "if value < LIMIT and value >= most:"),
    ("largest", "if value < LIMIT and value <= most:"),
    ("largest", "pass"),
    ("largest", "if values:"),
    ("largest", "if False:"),
    ("largest", "return -most"),
}


def test_changes_differ_from_source_as_names_say() -> None:
    unchanged = ast.unparse(ast.parse(_SOURCE)).splitlines()
    mutants = mutants_of("file.py", _SOURCE)
    assert {(mutant.name.split(":")[0].split()[1], mutant.name.partition(" ⇒ ")[2]) for mutant in mutants} == _EXPECTED
    assert len({mutant.name for mutant in mutants}) == len(mutants)
    for mutant in mutants:
        lines = mutated(_SOURCE, mutant.number).splitlines()
        ((_, line),) = (pair for pair in zip(unchanged, lines, strict=True) if pair[0] != pair[1])
        assert mutant.name.partition(" ⇒ ")[2] == line.strip() or "…" in mutant.name
