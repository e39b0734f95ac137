"""Sessions, sets and results opened by their path."""

from pathlib import Path

from faintfield.pipelines.arguments import SceneKind
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.results.records import RECONSTRUCTION_FILE
from faintfield.pipelines.formats.results.surface import SURFACE_FILE, results_below, surfaces_below
from faintfield.pipelines.formats.sets.elemental_file import FILE_NAME
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.session_set import load_session
from faintfield.pipelines.notebook.light_field import LightField
from faintfield.pipelines.notebook.results import Planes, Surface, planes_of_folder, surface_of_folder
from faintfield.rig.session.session import has_session


def open_path(path: Path | str, *, scene: SceneKind = "dark_scene") -> LightField | Planes | Surface:
    """Open a session, an elemental set or a folder of results.

    Parameters
    ----------
    path : path
        A session, whose noise and geometry are calibrated; a folder with elemental.toml; or a folder that holds the
        planes of one method or a surface, itself or in one of its folders.
    scene : {"dark_scene", "bright"}
        Frames of a session to take.

    Returns
    -------
    LightField, Planes or Surface
        The views of a session or set; planes; or a surface.

    Raises
    ------
    MissingFile
        There is no such folder, or nothing in it that can be opened; or a session is not calibrated yet.
    BadValue
        The folder holds several results; the message names them.

    Examples
    --------
    >>> import faintfield, tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     options = faintfield.SyntheticOptions(rows=3, columns=3, size_px=(64, 48), snr=1.0)
    ...     _ = faintfield.simulate(Path(folder) / "set", options=options)
    ...     faintfield.open(Path(folder) / "set")
    <light field of 9 views of 64 x 48 px, grey, poses stated, depths in mm>
    """
    folder = Path(path).expanduser()
    if not folder.exists():
        raise MissingFile(f"{folder}: no such folder; name a session, a set or a folder of results")
    if has_session(folder):
        return LightField(load_session(folder, scene))
    if folder.name in (RECONSTRUCTION_FILE, SURFACE_FILE):
        folder = folder.parent
    if folder.is_file() and folder.suffix != ".toml":
        raise MissingFile(f"{folder}: is a file; name its folder, a session, a set or a folder of results")
    if folder.is_file() or (folder / FILE_NAME).is_file():
        return LightField(load_set(folder))
    results: list[Path] = [*results_below(folder, required=False), *surfaces_below(folder)]
    if not results:
        return LightField(load_set(folder))  # which says what the folder lacks
    if len(results) > 1 and folder not in results:
        names = ", ".join(str(result) for result in results)
        raise BadValue(f"{folder}: holds {len(results)} results; open one of them: {names}")
    return _open_result(folder if folder in results else results[0])


def _open_result(folder: Path) -> Planes | Surface:
    if (folder / RECONSTRUCTION_FILE).is_file():
        return planes_of_folder(folder, results_below(folder)[folder])
    return surface_of_folder(folder)
