"""`faintfield export nerfstudio`: lens and poses of a set as transforms.json."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter


def export_nerfstudio(
    set_path: Annotated[Path, Parameter(name="SESSION|SET")], out: Path, /, *, overwrite: bool = False
) -> dict[str, str | int]:
    """Write lens and poses of an elemental set as a transforms.json of nerfstudio and instant-ngp.

    Its unit is that of the set, mm where they are known; its world is the reference camera's frame, with y down. Images
    are named as in the set and not copied: put the file beside them. Views with principal points of their own get
    lenses of their own.

    Parameters
    ----------
    set_path
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder to write.
    overwrite
        Replace an earlier transforms.json in OUT, a folder that holds nothing else.
    """
    from faintfield.pipelines.formats.exchange.imported_set import lens_of_each_view
    from faintfield.pipelines.formats.exchange.nerfstudio import FILE_NAME, write_transforms
    from faintfield.pipelines.formats.files import writing_folder
    from faintfield.pipelines.formats.sets.session_set import load_set_or_session

    elemental_set = load_set_or_session(set_path)
    names = [view.image for view in elemental_set.settings.view]
    with writing_folder(out, replace_only=[FILE_NAME] if overwrite else ()) as folder:
        write_transforms(folder, names, lens_of_each_view(elemental_set), elemental_set.poses_rt_cam_ref)
    return {"out": str(out), "views": len(names)}
