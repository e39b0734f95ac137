"""The form of a JSON file: its keys, their order, and the types of their values."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

GOLDEN = Path(__file__).parent / "golden"


def read_record(folder: Path, name: str = "reconstruction.json") -> dict[str, Any]:
    """Return the record of results in a folder."""
    record: dict[str, Any] = json.loads((folder / name).read_bytes())
    return record


def files_in(folder: Path, *without: str) -> dict[str, bytes]:
    """Return the contents of all files below a folder, by their names relative to it."""
    paths = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    return {name: path.read_bytes() for name, path in paths.items() if name not in without}


def plane_files(folder: Path) -> dict[str, bytes]:
    """Return the contents of the files of all planes below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("plane_*")}


def flip_last_bit(path: Path) -> None:
    """Damage a file, or mend it again."""
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))


def check_proposal(light: NDArray[Any], proposal: NDArray[Any], moved: NDArray[Any], moved_sigma: float) -> None:
    """Non-negative light and proposal, and their difference in positive units of noise."""
    assert light.dtype == proposal.dtype == moved.dtype == np.float32
    assert min(light.min(), proposal.min()) >= 0
    assert ((light - proposal) * moved >= 0).all()
    assert moved_sigma == pytest.approx(np.sqrt(np.mean(np.square(moved))), rel=0.02)


def form(value: Any) -> Any:
    """Return a JSON value's keys, in their order, and the types of its values; a list has the forms of its elements.

    A quantity has a value with its error, or none with the reason: which of the two is a matter of the frames.
    """
    if isinstance(value, dict) and list(value) in (["value", "se", "ci95"], ["value", "why"]):
        assert (value["value"] is None) == ("why" in value)
        return "quantity"
    if isinstance(value, dict):
        return [(key, form(item)) for key, item in value.items()]
    if isinstance(value, list):
        forms = [form(item) for item in value]
        return [kind for index, kind in enumerate(forms) if kind not in forms[:index]]
    return type(value).__name__


def form_of_result(path: Path) -> Any:
    """Return the form of a result, without the names of its inputs and without its digest, which came later."""
    content = json.loads(path.read_bytes())
    content.pop("record_sha256", None)
    if "inputs" in content:
        content["inputs"] = sorted({type(digest).__name__ for digest in content["inputs"].values()})
    return form(content)


def check_layout(made: Path, golden: str, *later: str) -> None:
    """The keys of a result, their order, and the types of their values are those of a golden file; some came later."""
    found, wanted = (json.loads(path.read_text()) for path in (made, GOLDEN / golden))
    assert list(found)[-1 - len(later) :] == [*later, "record_sha256"]
    for name in (*later, "record_sha256"):
        del found[name]
    for record in (found, wanted):
        assert all(isinstance(warning, str) for warning in record.pop("warnings", []))
    for plane in found.get("planes", []):
        del plane["fit"], plane["emva1288"]  # came later
    assert form(found) == form(wanted)
