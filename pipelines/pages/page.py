"""Parts that all pages share: templates, embedded pictures, and drawings in the colours of the page."""

import base64
import io
import re
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup, escape
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from faintfield.calib.estimate import Estimate
from faintfield.pipelines.formats.units import StatedUnits

# Colour of lines and text in drawings; in the SVG it is replaced by the page's own text colour, light or dark.
INK = "#010203"

# Symbols of EMVA 1288: a letter or an acronym with its subscript, and a square; or a part of DSNU or PRNU.
_SYMBOL = re.compile(
    r"\b(?:(?P<base>[A-Zμση]+)_(?P<low>[A-Za-z]+(?:\.[a-z]+)*)(?P<square>²?)|(?P<whole>DSNU|PRNU)\.(?P<part>[a-z]+))"
)

# Quality above 100, which OpenCV takes for WebP without losses.
LOSSLESS = 101

# The font of a drawing's text, and a picture within it.
_FONT = re.compile(r"font-family: [^;\"]+; ")
_EMBEDDED = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=\s]+)")
# Exponents.
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

# SNR beyond which the noise of a dark frame does not matter: it is less than a thirtieth of the light.
MAX_SNR = 1000


class Row(NamedTuple):
    """A line of a table of quantities; `why` is a remark, or the reason for no value."""

    name: str
    value: str = "–"
    error: str = ""
    unit: str = ""
    why: str = ""
    symbol: str = ""


class Quantity(NamedTuple):
    """A quantity of a table: its key in a record, and its unit on a page, to which the recorded value has a factor."""

    key: str
    name: str
    unit: str = ""
    symbol: str = ""
    factor: float = 1.0


class Fact(NamedTuple):
    """A number with its name and meaning."""

    name: str
    value: str
    means: str


def template(name: str) -> Template:
    """Return a page's template; its filter `figure` writes a number to three digits, `snr_text` an SNR."""
    return _environment().get_template(name)


def unbroken_options(text: str) -> Markup:
    """Return a text as HTML whose options, `--surface` for one, are code that no line breaks."""
    return Markup(re.sub(r"--[a-z-]+", r'<code class="option">\g<0></code>', str(escape(text))))


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("faintfield.pipelines.pages"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"figure": figure, "snr_text": snr_text, "unbroken": unbroken_options}
    return environment


def estimate_row(known: Estimate, quantity: Quantity) -> Row:
    """Return the line of a quantity, its interval to two digits of half its width."""
    _, name, unit, symbol, factor = quantity
    if known.value is None:
        return Row(name, unit=unit, why=known.why or "no reason stated", symbol=symbol)
    value = known.value * factor
    if known.ci95 is None:
        return Row(name, f"{value:.4g}".replace("-", "−"), "", unit, symbol=symbol)
    low, high = known.ci95[0] * factor, known.ci95[1] * factor
    half = (high - low) / 2
    scale = half if half > 0 else 1e-4 * abs(value) or 1.0
    digits = int(np.clip(1 - np.floor(np.log10(scale)), -8, 8))
    low_end, middle, high_end = (fixed(round(number, digits), digits) for number in (low, value, high))
    return Row(name, middle, f"{low_end} … {high_end}", unit, symbol=symbol)


def figure(value: float | None, digits: int = 3) -> str:
    """Return a number to `digits` significant digits, trailing zeros included; a dash for None."""
    if value is None:
        return "–"
    rounded = float(f"{value:.{digits}g}")
    if rounded == 0 or 1e-4 <= abs(rounded) < 1e6:
        decimals = digits - 1 - int(np.floor(np.log10(abs(rounded)))) if rounded else 0
        return fixed(rounded, decimals)
    mantissa, _, power = f"{rounded:.{digits - 1}e}".partition("e")
    return f"{mantissa} × 10{str(int(power)).translate(_RAISED)}".replace("-", "−")


def snr_text(snr: float) -> str:
    """Return an SNR, a ratio of powers; beyond `MAX_SNR` its digits depend on the last bits of the noise."""
    return figure(snr) if snr <= MAX_SNR else f"above {MAX_SNR}"


def fixed(value: float, decimals: int) -> str:
    """Return a number with fixed decimals, none if these are negative, and the minus sign of print."""
    return f"{value:.{max(decimals, 0)}f}".replace("-", "−")


def format_depths(units: StatedUnits, *depths: float, join: str = ", ") -> str:
    """Return depths in words, in their unit, with the minus sign of print."""
    return units.depths_text(depths, join).replace("-", "−")


def html_symbols(text: str) -> Markup:
    """Return a text with symbols such as μ_e.min set as HTML; the rest is escaped."""

    def set_symbol(match: re.Match[str]) -> str:
        return f"{match['base'] or match['whole']}<sub>{match['low'] or match['part']}</sub>{match['square'] or ''}"

    return Markup(_SYMBOL.sub(set_symbol, str(escape(text))))


def math_symbols(text: str) -> str:
    """Return a text with symbols such as σ_y.dark² set as Matplotlib's mathtext: letters are italic, words upright."""

    def set_symbol(match: re.Match[str]) -> str:
        word = match["base"] or match["whole"]
        base = word if len(word) == 1 else rf"\mathrm{{{word}}}"
        square = "^2" if match["square"] else ""
        return rf"${base}_{{\mathrm{{{match['low'] or match['part']}}}}}{square}$"

    return _SYMBOL.sub(set_symbol, text)


def data_uri(content: bytes, suffix: str) -> str:
    """Return the bytes of a picture's file as a data URI."""
    kind = {".png": "png", ".jpg": "jpeg", ".webp": "webp"}[suffix]
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def smaller_uri(content: bytes, quality: int = LOSSLESS) -> str:
    """Return a PNG as a data URI: as WebP if that is smaller, as it most often is by a third without losses.

    A PNG of 16 bits, or one that OpenCV cannot decode, is left as it is.
    """
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint8:
        return data_uri(content, ".png")
    done, packed = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, quality])
    return data_uri(packed.tobytes(), ".webp") if done and packed.size < len(content) else data_uri(content, ".png")


def blank_drawing(width_in: float, height_in: float, layout: Any = "constrained") -> tuple[Figure, Axes]:
    """Return a figure of a size in inches with one pair of axes."""
    figure = Figure(figsize=(width_in, height_in), layout=layout)
    return figure, figure.subplots()


def svg(figure: Figure) -> str:
    """Return a drawing as SVG in the font and text colour of the page; equal drawings give equal text."""
    text, undated = io.StringIO(), {"Date": None, "Creator": None}
    with rc_context({"svg.hashsalt": "faintfield", "svg.fonttype": "none"}):
        figure.savefig(text, format="svg", transparent=True, bbox_inches="tight", pad_inches=0.05, metadata=undated)
    drawn = text.getvalue()
    drawn = _FONT.sub("", drawn[drawn.index("<svg") :])
    drawn = _EMBEDDED.sub(lambda match: smaller_uri(base64.b64decode(match[1])), drawn)
    return drawn.replace(INK, "currentColor")


def ink(axes: Axes) -> None:
    """Give axes the colour `INK`, and remove the frame above and to the right."""
    axes.tick_params(which="both", colors=INK)
    axes.spines[:].set_color(INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.yaxis.get_offset_text().set_color(INK)
    for label in (axes.xaxis.label, axes.yaxis.label, axes.title):
        label.set_color(INK)


def colour_bar(figure: Figure, image: ScalarMappable, axes: Axes, label: str) -> None:
    """Draw the scale of a picture's colours beside it."""
    bar = figure.colorbar(image, ax=axes, shrink=0.8)
    bar.set_label(label, color=INK)
    bar.ax.ticklabel_format(useOffset=False)
    bar.ax.tick_params(colors=INK)
    bar.outline.set_edgecolor(INK)
