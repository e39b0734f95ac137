"""Records of results as a person writes them: without a digest, so that their numbers are taken as they stand."""

import json
from pathlib import Path
from typing import Any

from faintfield.pipelines.formats.digests import DIGEST_KEY


def write_by_hand(path: Path, record: dict[str, Any]) -> None:
    """Write a record, edited or new, without the digest that it may have had."""
    path.write_text(json.dumps({key: value for key, value in record.items() if key != DIGEST_KEY}))
