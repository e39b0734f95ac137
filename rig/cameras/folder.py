"""A camera behind any vendor's program: waits for the file that the program saves for each frame."""

from pathlib import Path

from faintfield.rig.cameras.protocol import CameraReport, Exposure
from faintfield.rig.cameras.settings import FolderSettings
from faintfield.rig.clock import Clock
from faintfield.rig.errors import CameraError, CameraTimeout

# Interval in s at which the folder is listed.
_POLL_S = 0.25

# A file is complete when its size has not changed in this many listings.
_QUIET_POLLS = 3


class FolderCamera:
    """A `Camera` that takes its frames from new files in a folder.

    Parameters
    ----------
    settings : FolderSettings
        The `[camera]` table.
    clock : Clock
        Clock of the waits.
    """

    def __init__(self, settings: FolderSettings, clock: Clock) -> None:
        self._settings = settings
        self._folder = Path(settings.folder)
        self._clock = clock
        self._known: set[Path] | None = None

    def open(self) -> None:
        """Remember the files that are already in the folder, which are not frames of this session."""
        if not self._folder.is_dir():
            raise CameraError(f"{self._folder}: is not a folder; create it, and let the camera's program save there")
        self._known = set(self._files())

    def report(self) -> CameraReport:
        """Return the folder's name."""
        self._require_open()
        return CameraReport(f"files in {self._folder}", round(self._settings.frame_mb * 1e6), readout_s=1.0)

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Wait for the next file to appear and become complete.

        Raises
        ------
        CameraTimeout
            No file appeared, or its size kept growing.
        CameraError
            Two files appeared at once, and either could be this frame.
        """
        known = self._require_open()
        known.update(self._files())  # a late or unrequested frame shows another position
        bound_s = exposure_s + self._settings.arrival_s
        deadline_s = self._clock.now_s() + bound_s
        sizes: list[int] = []
        while self._clock.now_s() < deadline_s:
            new = sorted(set(self._files()) - known)
            if len(new) > 1:
                known.update(new)
                raise CameraError(
                    f"{self._folder}: {len(new)} files came for one frame ({new[0].name}, {new[1].name}); "
                    "save one file a frame, then take this one again"
                )
            sizes.append(new[0].stat().st_size if new else 0)
            if new and sizes[-1] > 0 and sizes[-_QUIET_POLLS:] == [sizes[-1]] * _QUIET_POLLS:
                known.add(new[0])
                return Exposure(
                    new[0].suffix.lower(), content=new[0].read_bytes(), metadata={"camera_file": new[0].name}
                )
            self._clock.sleep_s(_POLL_S)
        state = "never stopped growing" if sizes and sizes[-1] else "no file came"
        raise CameraTimeout(
            f"{self._folder}: {state} within {bound_s:g} s; "
            "check that the camera's program is triggered and saves there"
        )

    def close(self) -> None:
        """Forget the folder's files."""
        self._known = None

    def _files(self) -> list[Path]:
        """Return the files with the configured suffixes."""
        return [path for path in self._folder.iterdir() if path.suffix.lower() in self._settings.suffixes]

    def _require_open(self) -> set[Path]:
        """Return the files seen so far; raises `CameraError` before `open`."""
        if self._known is None:
            raise CameraError("the camera is not connected; open it first")
        return self._known
