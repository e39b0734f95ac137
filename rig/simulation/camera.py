"""The camera of the simulated lab."""

from faintfield.rig.cameras.protocol import CameraReport, Exposure
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.clock import Clock
from faintfield.rig.errors import CameraError
from faintfield.rig.simulation.lab import SimulatedLab

# Key of the true pose in a frame's metadata.
TRUE_POSE = "true_rt_cam_ref"

# Time to read a frame.
_READOUT_S = 0.05

# Temperature of the cooled sensor, recorded with each frame.
_TEMPERATURE_C = -20.0

# Upper estimate of what a TIFF file holds besides its pixels.
_TIFF_HEADER_BYTES = 512


class SimulatedCamera:
    """A `Camera` that renders its frames; exposures take simulated time.

    Parameters
    ----------
    settings : SimulatedSettings
        The `[camera]` table.
    clock : Clock
        The simulated clock.
    lab : SimulatedLab
        Renders the frames.
    """

    def __init__(self, settings: SimulatedSettings, clock: Clock, lab: SimulatedLab) -> None:
        self._settings = settings
        self._clock = clock
        self._lab = lab
        self._open = False

    def open(self) -> None:
        """Connect."""
        self._open = True

    def report(self) -> CameraReport:
        """Return the size of a frame."""
        self._require_open()
        width, height = self._settings.size_px
        return CameraReport("simulated camera", 2 * width * height + _TIFF_HEADER_BYTES, readout_s=_READOUT_S)

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Render the scene from the camera's pose at the beginning of the exposure."""
        self._require_open()
        truth = [float(value) for value in self._lab.rt_cam_ref(exposure_s)]
        pixels = self._lab.expose(exposure_s, number)
        self._clock.sleep_s(exposure_s + _READOUT_S)
        return Exposure(
            ".tiff",
            pixels=pixels,
            metadata={"camera": "simulated camera", "temperature_c": _TEMPERATURE_C, TRUE_POSE: truth},
        )

    def close(self) -> None:
        """Disconnect."""
        self._open = False

    def _require_open(self) -> None:
        """Raise `CameraError` before `open` and after `close`."""
        if not self._open:
            raise CameraError("the camera is not connected; open it first")
