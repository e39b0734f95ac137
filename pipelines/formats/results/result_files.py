"""Reading the JSON files of results, with a named failure for a damaged one."""

from pathlib import Path
from typing import Annotated, Any

import msgspec

from faintfield.pipelines.errors import BadValue


def read_result(path: Path, kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Read a JSON file whole, after checking that it holds what `kind` names.

    Raises
    ------
    BadValue
        It does not.
    """
    try:
        content: dict[str, Any] = msgspec.json.decode(path.read_bytes())
        msgspec.convert(content, kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, OSError) as failure:
        raise BadValue(f"{path}: is not a result that can be shown ({failure}); reconstruct again") from failure
    return content


def read_record[Record](path: Path, kind: type[Record]) -> Record:
    """Read a JSON file as one of the types of `formats.results.records`.

    Raises
    ------
    BadValue
        The file is not of this type.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, OSError) as failure:
        raise BadValue(f"{path}: is not a result that can be shown ({failure}); reconstruct again") from failure
