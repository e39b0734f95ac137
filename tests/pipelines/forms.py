"""The form of a JSON file: its keys, their order, and the types of their values."""

import json
from pathlib import Path
from typing import Any


def form(value: Any) -> Any:
    """Return a JSON value's keys, in their order, and the types of its values; a list has the forms of its elements."""
    if isinstance(value, dict):
        return [(key, form(one)) for key, one in value.items()]
    if isinstance(value, list):
        forms = [form(one) for one in value]
        return [one for index, one in enumerate(forms) if one not in forms[:index]]
    return type(value).__name__


def form_of_result(path: Path) -> Any:
    """Return the form of a result, without the names of its inputs and without its digest, which came later."""
    content = json.loads(path.read_bytes())
    content.pop("record_sha256", None)
    if "inputs" in content:
        content["inputs"] = sorted({type(digest).__name__ for digest in content["inputs"].values()})
    return form(content)
