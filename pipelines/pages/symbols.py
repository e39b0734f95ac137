"""Symbols of EMVA 1288 such as μ_e.min and σ_y.dark², set with subscripts in HTML and in drawings."""

import re

from markupsafe import Markup, escape

# A letter or an acronym with its subscript, and a square; or a part of DSNU or PRNU
_SYMBOL = re.compile(
    r"\b(?:(?P<base>[A-Zμση]+)_(?P<low>[A-Za-z]+(?:\.[a-z]+)*)(?P<square>²?)|(?P<whole>DSNU|PRNU)\.(?P<part>[a-z]+))"
)


def html(text: str) -> Markup:
    """Return a text with its symbols set as HTML; the rest is escaped."""
    return Markup(_SYMBOL.sub(_as_html, str(escape(text))))


def _as_html(match: re.Match[str]) -> str:
    """Return one symbol as HTML."""
    return f"{match['base'] or match['whole']}<sub>{match['low'] or match['part']}</sub>{match['square'] or ''}"


def mathtext(text: str) -> str:
    """Return a text with its symbols set as Matplotlib's mathtext."""
    return _SYMBOL.sub(_as_mathtext, text)


def _as_mathtext(match: re.Match[str]) -> str:
    """Return one symbol as mathtext: letters are italic, words upright."""
    word = match["base"] or match["whole"]
    base = word if len(word) == 1 else rf"\mathrm{{{word}}}"
    square = "^2" if match["square"] else ""
    return rf"${base}_{{\mathrm{{{match['low'] or match['part']}}}}}{square}$"
