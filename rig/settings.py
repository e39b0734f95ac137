"""rig.toml: everything that a capture has to know about the rig, checked as it is read."""

import math

from msgspec import Struct

from faintfield.rig.boards import BoardSettings
from faintfield.rig.cameras.settings import CameraSettings, GPhoto2Settings, Mosaic
from faintfield.rig.plan import Grid, Step, StepKind
from faintfield.rig.stages.settings import StageSettings


class SettleSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The `[settle]` table: how long the rig rests at a node before the first exposure there.

    Parameters
    ----------
    measure : bool
        Find it once per session, from short frames after a long move.
    exposure_s : float
        Of these short frames.
    limit_px : float
        Which shift of the picture does no harm.
    longest_s : float
        How long to look; a rig that still swings then is reported.
    wait_s : float
        The rest that is planned with, and taken when nothing is measured.
    """

    measure: bool = True
    exposure_s: float = 0.01
    limit_px: float = 0.1
    longest_s: float = 3.0
    wait_s: float = 0.5

    def __post_init__(self) -> None:
        if min(self.exposure_s, self.longest_s, self.limit_px) <= 0.0 or self.wait_s < 0.0:
            raise ValueError(f"settle times and limits must be positive; got {self}")


class CheckSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The `[checks]` table: from where on a frame gives a warning.

    Parameters
    ----------
    saturation_dn : float, optional
        Value of a saturated pixel; without it, the largest that the file's type holds.
    saturated_share : float
        Largest share of saturated pixels in a lit frame.
    least_contrast_dn : float
        Smallest difference of the bright and the dark parts of a charuco or bright frame.
    least_flat_dn : float
        Smallest median of a flat frame.
    sharpness_share : float
        Smallest sharpness of a lit frame, as a share of the median of its step.
    board_corners : int
        Fewest board corners that make a charuco frame useful.
    leak_dn : float
        Largest difference of brightness between two parts of a frame that should be dark.
    """

    saturation_dn: float | None = None
    saturated_share: float = 0.01
    least_contrast_dn: float = 100.0
    least_flat_dn: float = 300.0
    sharpness_share: float = 0.5
    board_corners: int = 6
    leak_dn: float = 8.0

    def __post_init__(self) -> None:
        for name in ("saturated_share", "sharpness_share"):
            if not 0.0 <= (share := getattr(self, name)) <= 1.0:
                raise ValueError(f"{name} = {share:g}; a share lies between 0 and 1")


class DriftSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The `[drift]` table: homing again, to find lost steps that no report shows.

    Parameters
    ----------
    check : bool
        Whether to.
    limit_mm : float
        How much drift to look for.
    every_nodes : int
        How often, besides at the end of every step over the grid; 0: only then.
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
        Frames of each exposure time.
    at : str, optional
        `grid` or `centre`; without it, `centre` for dark and flat, `grid` for the rest.
    photons_per_s : float, optional
        Of a flat step, where the light has been measured: photons per pixel and second, mean over the detector. From it
        follows the quantum efficiency.
    """

    kind: StepKind
    exposure_s: float | tuple[float, ...]
    frames_per_node: int = 1
    at: str | None = None
    photons_per_s: float | None = None

    def __post_init__(self) -> None:
        if self.at not in (None, "grid", "centre"):
            raise ValueError(f"step.at = {self.at!r}; give 'grid' or 'centre'")
        if self.photons_per_s is not None and not (self.kind == "flat" and 0.0 < self.photons_per_s < math.inf):
            raise ValueError(
                f"step.photons_per_s = {self.photons_per_s} in a {self.kind} step; it is positive, and for flats only"
            )
        self.step()

    def step(self) -> Step:
        """Return the step of a plan."""
        exposures = self.exposure_s if isinstance(self.exposure_s, tuple) else (self.exposure_s,)
        centred = self.at == "centre" or (self.at is None and self.kind in ("dark", "flat"))
        return Step(self.kind, exposures, self.frames_per_node, "centre" if centred else "grid")


class SceneSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """The `[scene]` table.

    Parameters
    ----------
    depth_mm : tuple of float
        How far from the camera the objects stand: where `faintfield run` reconstructs planes.
    """

    depth_mm: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if any(not 0.0 < depth < math.inf for depth in self.depth_mm):
            raise ValueError(f"scene.depth_mm = {list(self.depth_mm)}; depths are positive")


class RigSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """A whole rig.toml."""

    stage: StageSettings
    camera: CameraSettings
    grid: Grid
    step: tuple[StepSettings, ...]
    settle: SettleSettings = SettleSettings()
    checks: CheckSettings = CheckSettings()
    drift: DriftSettings = DriftSettings()
    scene: SceneSettings = SceneSettings()
    board: tuple[BoardSettings, ...] = ()

    def __post_init__(self) -> None:
        if not self.step:
            raise ValueError("there is no [[step]]; say what to capture")
        if not self.board and any(step.kind == "charuco" for step in self.step):
            raise ValueError("there is a charuco step but no [[board]]; describe the printed boards")

    @property
    def mosaic(self) -> Mosaic | None:
        """The colour filters of a camera whose files do not say."""
        return None if isinstance(self.camera, GPhoto2Settings) else self.camera.mosaic

    def steps(self) -> tuple[Step, ...]:
        """Return the steps of the plan."""
        return tuple(step.step() for step in self.step)
