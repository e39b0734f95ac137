"""The content of rig.toml, which describes the rig of a capture."""

import math
from typing import Literal

import cv2
import numpy as np
from msgspec import Struct

from faintfield.rig.cameras.settings import CameraSettings, GPhoto2Settings, Mosaic
from faintfield.rig.lights.settings import LightSettings
from faintfield.rig.plan import CaptureStep, Grid, StepKind, Until, check_frame_count
from faintfield.rig.stages.protocol import StageSettings

# Longest rest at a node; all frames of the measurement are held in memory.
_MAX_REST_S = 3600.0


class BoardSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """A `[[board]]` table: one printed ChArUco board.

    Parameters
    ----------
    name : str
        Name in results and messages.
    columns, rows : int
        Number of squares.
    square_mm, marker_mm : float
        Sides of a square and of a marker.
    dictionary, first_marker_id : str, int
        OpenCV's name of the marker dictionary; number of the first marker: boards with different markers can be told
        apart.
    """

    name: str
    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str = "DICT_5X5_1000"
    first_marker_id: int = 0

    def __post_init__(self) -> None:
        if not hasattr(cv2.aruco, self.dictionary) or not self.dictionary.startswith("DICT_"):
            raise ValueError(f"board {self.name}: {self.dictionary!r} names no dictionary of OpenCV; try DICT_5X5_1000")
        available, markers = len(self._dictionary().bytesList), self.columns * self.rows // 2
        if not 0 <= self.first_marker_id <= available - markers:
            raise ValueError(
                f"board {self.name}: {self.dictionary} has {available} markers, too few for {markers} from "
                f"{self.first_marker_id} on; take a larger dictionary or a lower first_marker_id"
            )
        if min(self.columns, self.rows) < 3 or not 0.0 < self.marker_mm < self.square_mm:
            raise ValueError(
                f"board {self.name}: a board has at least 3 x 3 squares and markers smaller than these; "
                f"got {self.columns} x {self.rows}, {self.square_mm:g} mm and {self.marker_mm:g} mm"
            )

    def in_opencv(self) -> cv2.aruco.CharucoBoard:
        """Return OpenCV's board; its dictionary holds only the board's own markers, which speeds up detection."""
        predefined = self._dictionary()
        count = self.columns * self.rows // 2
        own = predefined.bytesList[self.first_marker_id : self.first_marker_id + count]
        dictionary = cv2.aruco.Dictionary(own, predefined.markerSize, predefined.maxCorrectionBits)
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_mm, self.marker_mm, dictionary, np.arange(count, dtype=np.int32)
        )

    def _dictionary(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))


class SettleSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The `[settle]` table: the rest at a node before the first exposure there.

    Parameters
    ----------
    measure, exposure_s : bool, float
        Measure the rest once per session, from short frames after a move; exposure time of the short frames.
    limit_px, board_limit_px : float
        Largest shift of the picture that does no harm; largest shift in board sweeps, whose corners are found to some
        thousandths of a pixel.
    longest_s : float
        Duration of the measurement; there is a warning if the rig still swings at its end.
    wait_s : float
        Rest that the plan assumes, and that is used if it is not measured.
    """

    measure: bool = True
    exposure_s: float = 0.01
    limit_px: float = 0.1
    board_limit_px: float = 0.01
    longest_s: float = 3.0
    wait_s: float = 1.0

    def __post_init__(self) -> None:
        positive = (self.exposure_s, self.longest_s, self.limit_px, self.board_limit_px)
        if min(positive) <= 0.0 or self.wait_s < 0.0:
            raise ValueError(f"settle times and limits must be positive; got {self}")
        for name in ("exposure_s", "longest_s", "wait_s"):
            if (duration_s := getattr(self, name)) > _MAX_REST_S:
                raise ValueError(f"settle.{name} = {duration_s:g}; at most {_MAX_REST_S:g} s are waited for rest")

    def limit_of(self, kind: StepKind) -> float:
        """Return the largest shift in pixels that does no harm in steps of a kind."""
        return self.board_limit_px if kind == "charuco" else self.limit_px


class CheckSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The `[checks]` table: limits beyond which a frame gives a warning.

    Parameters
    ----------
    saturation_dn : float, optional
        Value of a saturated pixel; by default the largest value of the file's data type.
    saturated_share : float
        Largest share of saturated pixels in a lit frame.
    least_contrast_dn, least_flat_dn : float
        Smallest difference between the bright and the dark parts of a charuco or bright frame; smallest median of a
        flat frame.
    sharpness_share : float
        Smallest sharpness of a charuco or bright frame, as a share of the median of its step.
    board_corners : int
        Smallest number of board corners that makes a charuco frame useful.
    leak_dn : float
        Largest difference between the means of two parts of a dark frame or a noise reference.
    transfer_px : float, optional
        Wanted error of the transfer between views, which the boards are to reach; by default the limit of
        `faintfield geometry`.
    """

    saturation_dn: float | None = None
    saturated_share: float = 0.01
    least_contrast_dn: float = 100.0
    least_flat_dn: float = 300.0
    sharpness_share: float = 0.5
    board_corners: int = 6
    leak_dn: float = 8.0
    transfer_px: float | None = None

    def __post_init__(self) -> None:
        for name in ("saturated_share", "sharpness_share"):
            if not 0.0 <= (share := getattr(self, name)) <= 1.0:
                raise ValueError(f"{name} = {share:g}; a share lies between 0 and 1")
        if self.transfer_px is not None and not 0.0 < self.transfer_px < math.inf:
            raise ValueError(f"transfer_px = {self.transfer_px:g}; an error is positive")


class DriftSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The `[drift]` table: checks for lost steps, which the controller does not notice, by homing again.

    Parameters
    ----------
    check, every_nodes : bool, int
        Check for drift after every step over the grid; number of nodes after which to check as well, 0 for never.
    limit_mm : float
        Smallest drift that counts.
    """

    check: bool = True
    limit_mm: float = 0.5
    every_nodes: int = 0


class StepSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """A `[[step]]` table.

    Parameters
    ----------
    kind : str
        `charuco`, `bright`, `dark_scene`, `noise_reference`, `dark` or `flat`.
    exposure_s : float or list of float
        One exposure time, or several.
    frames_per_node : int
        Number of frames of each exposure time at a node.
    at : str, optional
        `grid` or `centre`; by default `centre` for dark and flat, `grid` for the other kinds.
    photons_per_s : float, optional
        Measured light of a flat step in photons per pixel and second, mean over the detector; it gives the quantum
        efficiency.
    lights : tuple of str, optional
        Names of the lights that are on, while all others are off; by default a person switches the light, not the rig.
    until : Until, optional
        Repeat the whole grid until the planes will have this noise at the light that was measured; for `dark_scene`.
    """

    kind: StepKind
    exposure_s: float | tuple[float, ...]
    frames_per_node: int = 1
    at: str | None = None
    photons_per_s: float | None = None
    lights: tuple[str, ...] | None = None
    until: Until | None = None

    def __post_init__(self) -> None:
        if self.at not in (None, "grid", "centre"):
            raise ValueError(f"step.at = {self.at!r}; give 'grid' or 'centre'")
        if self.photons_per_s is not None and not (self.kind == "flat" and 0.0 < self.photons_per_s < math.inf):
            state = f"{self.photons_per_s} in a {self.kind} step"
            raise ValueError(f"step.photons_per_s = {state}; give it in flats, positive")
        self.step()

    def step(self) -> CaptureStep:
        """Return the step of the plan."""
        exposures = self.exposure_s if isinstance(self.exposure_s, tuple) else (self.exposure_s,)
        centred = self.at == "centre" or (self.at is None and self.kind in ("dark", "flat"))
        place: Literal["grid", "centre"] = "centre" if centred else "grid"
        return CaptureStep(self.kind, exposures, self.frames_per_node, place, self.lights, self.until)


class SceneSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The `[scene]` table: the scene in front of the camera.

    Parameters
    ----------
    depth_mm : tuple of float
        Distances of the objects from the camera, at which `faintfield run` reconstructs planes.
    """

    depth_mm: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if any(not 0.0 < depth < math.inf for depth in self.depth_mm):
            raise ValueError(f"scene.depth_mm = {list(self.depth_mm)}; depths are positive")


class RigSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """`rig.toml`: the rig and its capture (docs/how-to/run_a_capture.md).

    Parameters
    ----------
    stage : StageSettings
        The `[stage]` table.
    camera : CameraSettings
        The `[camera]` table, by its `backend`.
    grid : Grid
        The `[grid]` table: nodes of the camera.
    step : tuple of StepSettings
        The `[[step]]` tables: frames to take, in order.
    settle : SettleSettings
        The `[settle]` table: rest at each node before an exposure.
    checks : CheckSettings
        The `[checks]` table: limits beyond which a frame gives a warning.
    drift : DriftSettings
        The `[drift]` table: checks for lost steps.
    scene : SceneSettings
        The `[scene]` table: depths of the objects in mm.
    board : tuple of BoardSettings
        The `[[board]]` tables: the printed boards.
    light : tuple of LightSettings
        The `[[light]]` tables: lights that the rig switches.

    Raises
    ------
    ValueError
        The tables contradict one another; from a file, it is msgspec.ValidationError, which names the key.

    Examples
    --------
    >>> import msgspec
    >>> from faintfield import RigSettings
    >>> rig_toml = '''
    ... stage = {protocol = "grbl", port = "/dev/ttyUSB0"}
    ... camera = {backend = "gphoto2"}
    ... grid = {rows = 7, columns = 7, pitch_mm = 50.0, origin_mm = [-350.0, -350.0]}
    ... step = [{kind = "dark_scene", exposure_s = 0.1}]
    ... '''
    >>> settings = msgspec.toml.decode(rig_toml, type=RigSettings)
    >>> print(settings.grid.centre().target)
    (-200.000, -200.000) mm
    """

    stage: StageSettings
    camera: CameraSettings
    grid: Grid
    step: tuple[StepSettings, ...]
    settle: SettleSettings = SettleSettings()
    checks: CheckSettings = CheckSettings()
    drift: DriftSettings = DriftSettings()
    scene: SceneSettings = SceneSettings()
    board: tuple[BoardSettings, ...] = ()
    light: tuple[LightSettings, ...] = ()

    def __post_init__(self) -> None:
        if not self.step:
            raise ValueError("there is no [[step]]; say what to capture")
        if not self.board and any(step.kind == "charuco" for step in self.step):
            raise ValueError("there is a charuco step but no [[board]]; describe the printed boards")
        names = [light.name for light in self.light]
        if twice := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"two lights are named {min(twice)!r}; give each a name of its own")
        if not names and any(step.lights is not None for step in self.step):
            raise ValueError("a step has lights, but there is no [[light]]; describe what the rig switches")
        if unknown := {name for step in self.step for name in step.lights or ()}.difference(names):
            known = ", ".join(map(repr, names)) or "none"
            raise ValueError(f"step.lights has {min(unknown)!r}; the lights of [[light]] are: {known}")
        dark_scenes = [step for step in self.step if step.kind == "dark_scene"]
        if len(dark_scenes) > 1 and any(step.until is not None for step in dark_scenes):
            raise ValueError(
                f"until stands in one of {len(dark_scenes)} dark_scene steps, whose frames add up; keep a single one"
            )
        nodes = self.grid.rows * self.grid.columns
        stops = {"grid": nodes, "centre": 1}
        check_frame_count(sum(step.rounds * step.frames_per_stop() * stops[step.at] for step in self.steps()))

    @property
    def mosaic(self) -> Mosaic | None:
        """Colour filters of the camera if its files do not state them."""
        return None if isinstance(self.camera, GPhoto2Settings) else self.camera.mosaic

    def steps(self) -> tuple[CaptureStep, ...]:
        """Return the steps of the plan."""
        return tuple(step.step() for step in self.step)
