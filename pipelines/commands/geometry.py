"""`faintfield geometry`: where the camera was at every node, from images of ChArUco boards."""

from pathlib import Path
from typing import TYPE_CHECKING

from faintfield.pipelines.arguments import Positive
from faintfield.pipelines.choices import LensName

if TYPE_CHECKING:
    from faintfield.pipelines.workflows.geometry import GeometrySummary

type Result = GeometrySummary


def geometry(
    directory: Path,
    /,
    *,
    out: Path | None = None,
    lens: LensName = "opencv5",
    depth_mm: list[Positive] | None = None,
    limit_px: Positive = 0.5,
) -> Result:
    """Measure the lens, and where the camera was at every node, from images of ChArUco boards.

    Writes geometry.json, its covariance, a .cameramodel per node, and a page about the stage. A set that cannot tell
    the geometry is refused, with the reason and what to add.

    Parameters
    ----------
    directory
        A session with charuco frames, or a folder with charuco.toml and the images it names.
    out
        Folder for the results; DIRECTORY by default.
    lens
        Distortion model.
    depth_mm
        Depth of a plane that will be reconstructed; give it once per plane. 500 and 700 by default.
    limit_px
        How well the transfer between views by such a plane must be known: standard deviation, rms over views.
    """
    from faintfield.pipelines.workflows.geometry import measure_stage

    return measure_stage(directory, out, lens, depth_mm, limit_px)
