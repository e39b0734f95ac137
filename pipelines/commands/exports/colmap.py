"""`faintfield export colmap`: lens and poses of a set as a COLMAP sparse model."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter


def export_colmap(
    set_path: Annotated[Path, Parameter(name="SESSION|SET")],
    out: Path,
    /,
    *,
    binary: bool = False,
    overwrite: bool = False,
) -> dict[str, str | int]:
    """Write the lens and poses of an elemental set as a COLMAP model without points.

    Its unit is the mm, or that of the poses if the set has no scale: then lengths are relative, and the result says so.

    Views with principal points of their own get cameras of their own.

    Parameters
    ----------
    set_path
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder to write.
    binary
        .bin instead of .txt files.
    overwrite
        Replace an earlier model in OUT, a folder that holds nothing else.
    """
    from faintfield.pipelines.formats.exchange.colmap import MODEL_FILES, ColmapImage, ColmapModel, write_model
    from faintfield.pipelines.formats.exchange.imported_set import lens_of_each_view
    from faintfield.pipelines.formats.files import writing_folder
    from faintfield.pipelines.formats.sets.session_set import load_set_or_session
    from faintfield.pipelines.formats.sets.stated import stated_length

    elemental_set = load_set_or_session(set_path)
    lenses = lens_of_each_view(elemental_set)
    cameras = {lens: number for number, lens in enumerate(dict.fromkeys(lenses), start=1)}
    model = ColmapModel(
        {number: lens for lens, number in cameras.items()},
        [
            ColmapImage(view.image, cameras[lens], pose)
            for view, lens, pose in zip(
                elemental_set.settings.view, lenses, elemental_set.poses_rt_cam_ref, strict=True
            )
        ],
    )
    unit = stated_length(elemental_set, "mm")
    with writing_folder(out, replace_only=MODEL_FILES if overwrite else ()) as folder:
        write_model(folder, model, binary=binary)
    return {"out": str(out), "views": len(model.images), "unit": unit}
