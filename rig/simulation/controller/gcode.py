"""Words of G-code, such as `X-12.5`, as the simulated controllers read them."""

import re

WORD = re.compile(r"([A-Z])(-?\d+(?:\.\d+)?)")


def words(text: str) -> dict[str, float]:
    """Return the numbers of a line by letter; the last word of a letter counts."""
    return {letter: float(value) for letter, value in WORD.findall(text)}
