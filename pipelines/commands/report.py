"""`faintfield report`: write report.html again."""

from pathlib import Path

from faintfield.pipelines.console import inform, working


def report(directory: Path, /) -> dict[str, str]:
    """Write report.html again from the results in a folder and the folders within it.

    The page begins with the planes next to what the camera saw. Then come sliders; errors; noise and geometry of the
    camera, if noise.json and geometry.json are in the folder or in one of the two above; the set and its light; and how
    everything was made.

    Parameters
    ----------
    directory
        Folder with reconstruction.json or surface.json, or whose folders have one: what `reconstruct` wrote,
        or a session.
    """
    from faintfield.pipelines.pages.report import write_report

    with working("writing the report"):
        path = write_report(directory)
    inform(f"{path}")
    return {"report": str(path)}
