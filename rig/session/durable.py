"""Make renames survive a power cut; for sessions and for results."""

import os
from pathlib import Path


def sync_folder(folder: Path) -> None:
    """Flush the entries of a folder, so that a rename survives a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
