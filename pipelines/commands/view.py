"""`faintfield view`: the planes of a folder in napari."""

from pathlib import Path


def view(directory: Path, /) -> dict[str, list[str]]:
    """Open the planes of a folder in napari, if it is installed: in the units of the set, on one grey scale.

    A few planes are one layer each; a sweep in equal steps is one layer per method, with a slider over depth.

    Parameters
    ----------
    directory
        Folder with reconstruction.json, or whose folders have one: what `reconstruct` wrote, or a session.
    """
    from faintfield.pipelines.pages.napari_layers import show_planes

    return {"layers": show_planes(directory)}
