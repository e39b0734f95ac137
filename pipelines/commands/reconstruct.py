"""`faintfield reconstruct`: planes of a session or an elemental set at chosen depths."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from faintfield.pipelines.choices import SceneKind
from faintfield.pipelines.reconstruction.options import DEFAULTS, Options

if TYPE_CHECKING:
    from faintfield.pipelines.reconstruction.run import Outcome

type Result = Outcome


def reconstruct(
    set_path: Annotated[Path, Parameter(name="SESSION|SET")],
    /,
    *,
    out: Path | None = None,
    options: Options = DEFAULTS,
    geometry: Path | None = None,
    scene: SceneKind = "dark_scene",
) -> Result:
    """Reconstruct planes of the scene at chosen depths, or one picture that is sharp everywhere, with its depth.

    Each plane becomes a float32 TIFF (expected electrons per detector pixel of the reference view), a preview, and an
    entry in reconstruction.json; report.html shows them all. With several methods, each has its own folder in OUT.
    Planes that were already made of the same files with the same options are kept, so an interrupted sweep resumes.

    Parameters
    ----------
    set_path
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder for the results; planes of the same depth are replaced. By default, for a session, its folder
        reconstructions.
    geometry
        geometry.json, or its folder; its lens and measured poses replace those of the set, node by node.
    scene
        Set of the session to reconstruct: the dark scene or the bright scene.
    """
    from faintfield.pipelines.workflows.reconstruct import reconstruct_folder

    return reconstruct_folder(set_path, out, options, geometry, scene)
