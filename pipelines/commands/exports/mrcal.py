"""`faintfield export mrcal`: lens and poses of a set as .cameramodel files."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from faintfield.pipelines.errors import BadValue


def export_mrcal(
    set_path: Annotated[Path, Parameter(name="SESSION|SET")], out: Path, /, *, overwrite: bool = False
) -> dict[str, str | int]:
    """Write the lens and poses of an elemental set as .cameramodel files, one per view, in metres.

    Of a set without a scale lengths are relative, thousandths of those of its poses, and the result says so.

    Parameters
    ----------
    set_path
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder to write.
    overwrite
        Replace earlier models in OUT, a folder that holds nothing else.
    """
    from faintfield.pipelines.formats.exchange.imported_set import lens_of_each_view
    from faintfield.pipelines.formats.exchange.mrcal import SUFFIX, camera_model_text, lens_model_of
    from faintfield.pipelines.formats.files import write_whole, writing_folder
    from faintfield.pipelines.formats.sets.session_set import load_set_or_session
    from faintfield.pipelines.formats.sets.stated import stated_length

    elemental_set = load_set_or_session(set_path)
    models: dict[str, str] = {}
    for view, lens, pose in zip(
        elemental_set.settings.view, lens_of_each_view(elemental_set), elemental_set.poses_rt_cam_ref, strict=True
    ):
        name = Path(view.image).with_suffix(SUFFIX).name
        if name in models:
            raise BadValue(f"{set_path}: {view.image} would become {name} like another view; rename its image")
        models[name] = camera_model_text(lens, lens_model_of(lens), pose)
    unit = stated_length(elemental_set, "m")
    with writing_folder(out, replace_only=[f"*{SUFFIX}"] if overwrite else ()) as folder:
        for name, text in models.items():
            write_whole(folder / name, text)
    return {"out": str(out), "views": len(models), "unit": unit}
