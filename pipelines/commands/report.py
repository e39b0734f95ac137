"""`faintfield report`: draw report.html anew."""

from pathlib import Path
from typing import Any

from faintfield.pipelines.console import inform
from faintfield.pipelines.pages.report import write_report


def report(directory: Path, /) -> dict[str, Any]:
    """Draw report.html anew from the results in a folder and the folders within it.

    It leads with the planes beside what the camera saw; then come sliders, errors, the noise and the geometry of the
    camera where noise.json and geometry.json lie there or in one of the two folders above, the set and its light, and
    how everything was made.

    Parameters
    ----------
    directory
        Folder with reconstruction.json, or whose folders have one: what `reconstruct` wrote, or a session.
    """
    path = write_report(directory)
    inform(f"{path}")
    return {"report": str(path)}
