"""`faintfield view`: the planes of a folder in napari."""

from pathlib import Path

import msgspec

from faintfield.pipelines.pages.napari_layers import show_planes


class Viewed(msgspec.Struct, frozen=True):
    """The result of `faintfield view`."""

    layers: list[str]


def view(directory: Path, /) -> Viewed:
    """Open the planes of a folder in napari, if it is installed: in millimetres, on one grey scale.

    A few planes are one layer each; a sweep in equal steps is one layer per method, with a slider over depth.

    Parameters
    ----------
    directory
        Folder with reconstruction.json, or whose folders have one: what `reconstruct` wrote, or a session.
    """
    return Viewed(show_planes(directory))
