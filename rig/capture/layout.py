"""Refuse a frame that is damaged, or of another size or depth than the frames of its session."""

from pathlib import Path
from typing import NamedTuple

from faintfield.rig.cameras.protocol import Decode, Exposure, Pixels
from faintfield.rig.errors import CameraError
from faintfield.rig.plan import PlannedFrame
from faintfield.rig.session.journal import CommittedFrame
from faintfield.rig.session.session import Session


class Layout(NamedTuple):
    """Size and type of the pixels of a frame.

    Attributes
    ----------
    shape : tuple of int
        Rows and columns, and colours if there are any. A mosaic of colour filters has none: its pixels have one value.
    depth : str
        Name of the type of a value, such as `uint16`.
    """

    shape: tuple[int, ...]
    depth: str

    @classmethod
    def of(cls, pixels: Pixels) -> "Layout":
        """Return the layout of an array."""
        return cls(pixels.shape, pixels.dtype.name)

    def __str__(self) -> str:
        """Return the layout in words, such as `640 x 480 pixels of uint16`."""
        colours = f" x {self.shape[2]} colours" if len(self.shape) == 3 else ""
        return f"{self.shape[1]} x {self.shape[0]} pixels{colours} of {self.depth}"


class LayoutCheck:
    """Compares each frame with the first one of its session; boards, scene, darks and flats share one layout.

    Parameters
    ----------
    session : Session
        Open session.
    decode : callable
        Reads the pixels of a frame's file.
    """

    def __init__(self, session: Session, decode: Decode) -> None:
        self._session = session
        self._decode = decode
        self._known: dict[str, Layout | None] = {}

    def pixels_of(self, frame: PlannedFrame, path: Path, exposure: Exposure) -> Pixels | None:
        """Return the pixels of a frame that was just written, None if it cannot be decoded here.

        Raises
        ------
        CameraError
            The file is damaged, or its pixels are of another number or depth than those of the session.
        """
        pixels = exposure.pixels if exposure.pixels is not None else self._decode(path)
        layout = None if pixels is None else Layout.of(pixels)
        first = self._first_besides(frame)
        expected = None if first is None else self._layout_of(first)
        if first is not None and expected is not None and layout != expected:
            what = f"has {layout}" if layout else "cannot be decoded"
            raise CameraError(
                f"{path.name}: {what}, but {first.file} has {expected}; set the camera as it was when the session was "
                "begun, and take this frame again"
            )
        self._known[path.name] = layout
        return pixels

    def _first_besides(self, frame: PlannedFrame) -> CommittedFrame | None:
        """Return the first frame that is taken; one that is taken again is not compared with itself."""
        taken = self._session.valid()
        return taken.get(min(taken.keys() - {frame.number}, default=-1))

    def _layout_of(self, taken: CommittedFrame) -> Layout | None:
        if taken.file not in self._known:
            try:
                pixels = self._decode(self._session.path_of(taken))
            except CameraError:  # a session of an earlier version may hold such a frame
                pixels = None
            self._known[taken.file] = None if pixels is None else Layout.of(pixels)
        return self._known[taken.file]
