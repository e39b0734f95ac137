"""Put the numbers of a finished demo into docs/results.json, docs/quality.md and the paper.

`python docs/collect_results.py demo`

`filled` makes their table from results.json, and a test compares the two, so that no number is typed by hand.
"""

import json
import re
import sys
from pathlib import Path
from typing import Any

_DOCS = Path(__file__).parent
RESULTS = _DOCS / "results.json"
PAGES = _DOCS / "quality.md", _DOCS.parent / "paper" / "paper.md"
_BLOCK = re.compile(
    r"(?<=<!-- results: made by docs/collect_results.py -->\n).*?(?=<!-- end of results -->)", re.DOTALL
)
_METHODS = {
    ("backprojection", None): "mean of the views",
    ("pmlem-osl", "tv"): "PMLEM, the paper's one-step-late iteration",
    ("pmlem", "tv"): "PMLEM, total variation alone, to its optimum",
    ("occlusion", "auto"): "**PMLEM, both planes together, with occlusion**",
}
_ERRORS = {"mse_texture": "object at {:g} mm", "mse_plane": "whole plane at {:g} mm"}
_NOISE = {
    "gain_dn_per_e": ("gain", "DN/e⁻"),
    "read_noise_e": ("read noise", "e⁻"),
    "dark_current_e_per_s": ("dark current", "e⁻/s"),
}


def collect(demo: Path) -> dict[str, Any]:
    """Return the numbers of the demo in a folder that pages state, rounded to their precision."""
    metrics = json.loads((demo / "metrics.json").read_text())
    made = json.loads(next(demo.rglob("reconstruction.json")).read_text())
    planes = [
        {key: row.get(key) for key in ("depth_mm", "method", "prior", "poses")}
        | {key: float(f"{row[key]:.3g}") for key in _ERRORS}
        for row in metrics["planes"]
    ]
    results = {
        "version": made["versions"]["faintfield"],
        "snr": float(f"{metrics['snr']['measured']:.2g}"),
        "photons_per_px": float(f"{metrics['photons_per_px']['from_moments']:.2g}"),
        "planes": planes,
    }
    if "geometry" in metrics:
        results["centre_rms_mm"] = float(f"{metrics['geometry']['centre_rms_mm']:.2g}")
    if "noise" in metrics:
        results["noise"] = {
            name: {key: float(f"{metrics['noise'][name][key]:.4g}") for key in ("value", "se", "truth")}
            for name in _NOISE
        }
    return results


def table(results: dict[str, Any]) -> str:
    """Return the results as a Markdown table and a sentence."""
    depths = sorted({row["depth_mm"] for row in results["planes"]})
    columns = [(key, depth) for key in _ERRORS for depth in depths]
    lines = [
        f"| mean square error at SNR {results['snr']:g}, {results['photons_per_px']:g} photons per pixel | "
        + " | ".join(_ERRORS[key].format(depth) for key, depth in columns)
        + " |",
        "|---|" + "---|" * len(columns),
    ]
    rows = sorted(results["planes"], key=lambda row: list(_METHODS).index((row["method"], row["prior"])))
    errors = {
        (f"{_METHODS[row['method'], row['prior']]}, {row['poses']} poses", key, row["depth_mm"]): f"{row[key]:.4f}"
        for row in rows
        for key in _ERRORS
    }
    for name in dict.fromkeys(name for name, _, _ in errors):
        cells = " | ".join(errors.get((name, key, depth), "–") for key, depth in columns)
        lines.append(f"| {name} | {cells} |")
    measured = [
        f"{words} {known['value']:g} ± {known['se']:.1g} {unit} (true: {known['truth']:g})"
        for name, (words, unit) in _NOISE.items()
        if (known := results.get("noise", {}).get(name))
    ]
    if "centre_rms_mm" in results:
        measured.insert(0, f"camera centres {results['centre_rms_mm']:g} mm rms off the true ones")
    return "\n".join([*lines, *(["", f"Measured on the way: {'; '.join(measured)}."] if measured else [])]) + "\n"


def filled(page: str, results: dict[str, Any]) -> str:
    """Return the text of a page with its marked block replaced."""
    made, count = _BLOCK.subn(lambda _: table(results), page)
    if count != 1:
        raise ValueError(f"the page has {count} marked blocks of results; leave exactly one")
    return made


if __name__ == "__main__":
    found = collect(Path(sys.argv[1]))
    RESULTS.write_text(json.dumps(found, indent=2) + "\n")
    for page in PAGES:
        page.write_text(filled(page.read_text(), found))
