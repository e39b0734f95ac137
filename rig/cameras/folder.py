"""A camera behind any vendor's program, which saves each frame as a file in a folder."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from faintfield.rig.cameras.protocol import CameraReport, Decode, Exposure
from faintfield.rig.cameras.settings import FolderSettings
from faintfield.rig.clock import Clock
from faintfield.rig.errors import CameraError, CameraTimeout

# Interval in s at which the folder is listed.
_POLL_S = 0.25
# A file is decoded, to see whether it is complete, when it has not changed for this time in s.
_QUIET_S = 0.5
# File systems keep times rounded: ext4 to a tick of 4 ms to 10 ms, NFS and HFS+ to 1 s at worst, FAT to 2 s. A file is
# too old only if it is so by more than this.
_TIME_GRAIN_S = 2.0
# The end of a file that was given its size before it was written is zeros. So is that of a file whose last pixels are
# black; therefore such a file is given more time, but not refused.
_ZERO_TAIL_BYTES = 512
# A file for this moment is made, and removed, to learn the time by the clock of the folder's file system.
_PROBE = ".faintfield-time"


@dataclass
class _Arrival:
    """A file that is being written, in the state that it has had since `since_s`; `problem` is why it is no picture."""

    path: Path
    size_bytes: int
    changed_ns: int
    since_s: float
    problem: str = ""


class FolderCamera:
    """A `Camera` that takes its frames from new files in a folder.

    `decode` reads the pixels of a file, to see whether it is complete; without it every kind of file is an unknown one.
    """

    def __init__(self, settings: FolderSettings, clock: Clock, decode: Decode = lambda path: None) -> None:
        self._settings = settings
        self._folder = Path(settings.folder)
        self._clock = clock
        self._decode = decode
        self._known: set[Path] | None = None
        self._device = 0
        self._known_when_late: set[Path] | None = None
        # Upper bound of the delay of files, that of the frame that came soonest; until there is one, and after a file
        # that nobody asked for, the longest allowed.
        self._delay_s = settings.arrival_s
        self._is_silent = False

    def open(self) -> None:
        """Remember the files that are already in the folder, which are not frames of this session."""
        if not self._folder.is_dir():
            raise CameraError(f"{self._folder}: is not a folder; create it, and let the camera's program save there")
        with self._translate_errors():
            self._device = self._folder.stat().st_dev
            self._known = set(self._files())
        self._is_silent = False

    def report(self) -> CameraReport:
        """Return the folder's name."""
        self._require_open()
        wait_s = self._settings.silence_s if self._settings.delay_s is None else self._settings.delay_s
        return CameraReport(f"files in {self._folder}", round(self._settings.frame_mb * 1e6), readout_s=1.0 + wait_s)

    def await_silence(self, exposure_s: float) -> None:
        """Wait until no file has come for the exposure time and `silence_s`, or the delay of files if that is longer.

        With the stage at rest, an exposure that began while it moved would have come meanwhile. Raises `CameraError` if
        a file comes: the program takes frames by itself, and which of them begin after a request is not known, as the
        delay of its files is not. With `delay_s` it is, and nothing is waited for.
        """
        known = self._require_open()
        if self._settings.delay_s is not None:
            return
        with self._translate_errors():
            if self._pass_over(known):  # late and stray files show another position
                self._known_when_late = None
            since_s = self._clock.now_s()
            while self._clock.now_s() < since_s + exposure_s + max(self._settings.silence_s, self._delay_s):
                self._clock.sleep_s(_POLL_S)
                if names := self._pass_over(known):
                    if self._known_when_late is None:
                        raise CameraError(
                            f"{self._folder / names[0]}: came {self._clock.now_s() - since_s:.1f} s into the silence "
                            "before a request; the program takes frames by itself, and one may begin while the stage "
                            "moves: let it take one frame each time it is triggered, or state camera.delay_s"
                        )
                    self._known_when_late, since_s = None, self._clock.now_s()  # the frame that did not come in time
        self._is_silent = True

    def _pass_over(self, known: set[Path]) -> list[str]:
        """Take the files that are new for no frames, and return their names."""
        new = sorted(set(self._files()) - known)
        if new:
            known.update(new)
            self._delay_s = self._settings.arrival_s
        return [path.name for path in new]

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Wait for the next file to appear and become complete.

        A file is complete when it decodes as a whole picture. One that cannot be decoded here, or that ends in zeros,
        is complete when neither its size nor its time has changed for `quiet_s`.

        A file that appears too early is refused, and the first after a frame that did not come in time: it may be that
        frame. A silence comes first unless there was one, and only frames that were asked for since.
        """
        known = self._require_open()
        bound_s = exposure_s + self._settings.arrival_s
        with self._translate_errors():
            if not self._is_silent or set(self._files()) - known:
                self.await_silence(exposure_s)
            self._is_silent = False
            files = set(self._files())
            if self._known_when_late is not None and files - self._known_when_late:
                self._known_when_late = None  # the late file has come in the meantime
            asked_s, folder_time_s = self._clock.now_s(), self._folder_time_s()
            if self._settings.delay_s is not None:  # the files of frames that were begun before the request come first
                self._clock.sleep_s(exposure_s + self._settings.delay_s)
                bound_s += exposure_s + self._settings.delay_s
            self._pass_over(known)
            arrival: _Arrival | None = None
            while self._clock.now_s() < asked_s + bound_s:
                arrival = self._arriving_file(known, arrival)
                if arrival is not None:
                    reason = self._late_reason() or self._early_reason(arrival, exposure_s, asked_s, folder_time_s)
                    if reason:
                        self._pass_over(known)
                        raise CameraError(f"{arrival.path}: {reason}")
                    if self._is_complete(arrival):
                        known.add(arrival.path)
                        self._delay_s = min(self._delay_s, self._clock.now_s() - asked_s - exposure_s)
                        self._is_silent = True
                        suffix, name = arrival.path.suffix.lower(), arrival.path.name
                        return Exposure(suffix, arrival.path.read_bytes(), metadata={"camera_file": name})
                self._clock.sleep_s(_POLL_S)
        if arrival is None:
            self._known_when_late, state = set(known), "no file came"
        else:
            state = f"{arrival.path.name} {arrival.problem or 'never stopped growing'}"
            self._pass_over(known)
        remedy = "check that the camera's program is triggered and saves there"
        raise CameraTimeout(f"{self._folder}: {state} within {bound_s:g} s; {remedy}")

    def close(self) -> None:
        """Forget the folder's files."""
        self._known = None

    def _folder_time_s(self) -> float | None:
        """Return the time in s by the file system's clock, which for a network folder is that of another computer."""
        probe = self._folder / _PROBE
        if not self._settings.file_times:
            return None
        try:
            probe.write_bytes(b"")
            return probe.stat().st_mtime
        except OSError:
            return None  # the folder cannot be written to: then only the time at which files appear counts
        finally:
            with suppress(OSError):
                probe.unlink()

    def _arriving_file(self, known: set[Path], before: _Arrival | None) -> _Arrival | None:
        new = sorted(set(self._files()) - known)
        if self._settings.delay_s is not None:  # more frames may follow
            new = [before.path] if before is not None and before.path in new else new[:1]
        if len(new) > 1:
            self._pass_over(known)
            problem = f"{self._folder}: {len(new)} files came for one frame ({new[0].name}, {new[1].name})"
            raise CameraError(f"{problem}; save one file a frame, then take this one again")
        if not new:
            return None
        try:
            status = new[0].stat()
        except FileNotFoundError:  # it was renamed after the listing
            return None
        state = (new[0], status.st_size, status.st_mtime_ns)
        if before is not None and (before.path, before.size_bytes, before.changed_ns) == state:
            return before
        return _Arrival(*state, self._clock.now_s())

    def _late_reason(self) -> str:
        """Return why the first file after a frame that did not come in time is refused, "" if it is another."""
        if self._known_when_late is None or self._settings.delay_s is not None:  # a stated delay says which it is
            return ""
        self._known_when_late = None
        return (
            "may be the frame before, which did not come in time; take this frame again, and raise camera.arrival_s if "
            "files often come late"
        )

    def _early_reason(self, arrival: _Arrival, exposure_s: float, asked_s: float, folder_time_s: float | None) -> str:
        """Return why a file is refused whose exposure was begun before the request, perhaps while the stage moved."""
        # Read after the listing, so that a file is never taken for an earlier one than it is
        after_s = self._clock.now_s() - asked_s
        if after_s < exposure_s:
            return (
                f"came {after_s:.2f} s after the request for a frame of {exposure_s:g} s, so that its exposure was "
                "begun before; start no exposure by hand, state the camera's true exposure time, and take this frame "
                "again"
            )
        changed_s = 1e-9 * arrival.changed_ns
        if folder_time_s is None or folder_time_s + exposure_s - changed_s <= _TIME_GRAIN_S:
            return ""
        return (
            f"was last changed at {_utc(changed_s)}, {folder_time_s + exposure_s - changed_s:.1f} s before the "
            f"exposure of {exposure_s:g} s that was asked for at {_utc(folder_time_s)} could end; "
            "take this frame again, or set camera.file_times = false if the program keeps the camera's own time"
        )

    def _is_complete(self, arrival: _Arrival) -> bool:
        quiet_s = self._clock.now_s() - arrival.since_s
        long_quiet = quiet_s >= self._settings.quiet_s
        arrival.problem = ""
        if arrival.size_bytes == 0 or quiet_s < _QUIET_S:
            return False
        with arrival.path.open("rb") as file:
            file.seek(max(arrival.size_bytes - _ZERO_TAIL_BYTES, 0))
            ends_in_zeros = not any(file.read(_ZERO_TAIL_BYTES))
        if ends_in_zeros and not long_quiet:
            return False
        try:
            return self._decode(arrival.path) is not None or long_quiet
        except CameraError as failure:
            arrival.problem = f"is not complete ({str(failure).partition('; ')[0]})"
            return False

    def _files(self) -> list[Path]:
        if self._folder.stat().st_dev != self._device:  # where a disk was mounted, an empty folder remains
            raise self._gone()
        return [path for path in self._folder.iterdir() if path.suffix.lower() in self._settings.suffixes]

    @contextmanager
    def _translate_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as failure:
            if not self._folder.is_dir():
                raise self._gone() from failure
            problem = f"{failure.filename or self._folder}: cannot be read ({failure.strerror})"
            raise CameraError(f"{problem}; check the disk or the network, and take this frame again") from failure

    def _gone(self) -> CameraError:
        return CameraError(f"{self._folder}: the folder is gone; mount it again, and take this frame again")

    def _require_open(self) -> set[Path]:
        if self._known is None:
            if not self._folder.is_dir():  # opening it again after a failure has failed, too
                raise self._gone()
            raise CameraError("the camera is not connected; open it first")
        return self._known


def _utc(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%H:%M:%S.%f")[:-5] + " UTC"
