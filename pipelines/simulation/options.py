"""Options of simulated and darkened sets, apart from the code that makes them: help is shown without loading that."""

from dataclasses import dataclass
from typing import Annotated, Literal

from cyclopts import Parameter

from faintfield.pipelines.arguments import Count, Fraction, NotNegative, Positive, Seed, SizePx


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SyntheticOptions:
    """Options of `faintfield simulate`, as provenance.json records them.

    Parameters
    ----------
    snr : float
        SNR, eq. (4), over the object region of the reference view; it sets the light.
    seed : int
        Seed of the random generator.
    rows : int
        Rows of the grid of nodes.
    columns : int
        Columns of the grid of nodes.
    pitch_mm : float
        Distance between neighbouring nodes.
    size_px : (int, int)
        Width and height of the detector.
    exposure_s : float
        Exposure of each view.
    position_error_mm : float
        Standard deviation of the translation of each node's pose along each axis; the centre node has no error.
    rotation_error_mrad : float
        Standard deviation of each node's rotation about each axis; the centre node has no error.
    poses : {"true", "nominal"}
        Poses that elemental.toml states: those the camera really had (true), or those it was sent to (nominal).
    colour : {"grey", "bayer"}
        Sensor without colour filters (grey), or with a Bayer mosaic.
    lens : {"real", "ideal"}
        The paper's lens, with distortion and a principal point beside the middle (real), or one without (ideal), as
        `import grid` takes that of pictures to be.
    objects : {"toys", "surfaces"}
        The flat toys, or a scene that fills the view: a slanted wall, a rising floor, a ball, a tilted page and a thin
        rod (surfaces), at 517 to 1009 mm.

    Examples
    --------
    The defaults are those of the paper; a small set in more light:

    >>> from faintfield import SyntheticOptions
    >>> options = SyntheticOptions(rows=3, columns=3, size_px=(160, 120), snr=1.0)
    >>> options.pitch_mm, options.exposure_s
    (50.0, 0.1)
    """

    snr: Positive = 0.16
    seed: Seed = 1
    rows: Count = 7
    columns: Count = 7
    pitch_mm: Positive = 50.0
    size_px: SizePx = (640, 480)
    exposure_s: Positive = 0.1
    position_error_mm: NotNegative = 0.3
    rotation_error_mrad: NotNegative = 3.5
    poses: Literal["true", "nominal"] = "true"
    colour: Literal["grey", "bayer"] = "grey"
    lens: Literal["real", "ideal"] = "real"
    objects: Literal["toys", "surfaces"] = "toys"


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DarkeningOptions:
    """Options of `faintfield darken`, as provenance.json records them; the camera is by default the paper's.

    Parameters
    ----------
    snr
        SNR of the reference view, eq. (4).
    seed
        Seed of the random generator.
    exposure_s
        Exposure of each dark view.
    read_noise_e
        Standard deviation of the dark camera's read noise.
    dark_current_e_per_s
        Dark electrons per pixel and second of the dark camera.
    quantum_efficiency
        Electrons per photon of the dark camera.
    """

    snr: Positive = 0.16
    seed: Seed = 1
    exposure_s: Positive = 0.1
    # As of the paper's camera, see `rig.simulation.optics`
    read_noise_e: Annotated[NotNegative, Parameter(show_default="{:.3f}".format)] = 12.0**0.5
    dark_current_e_per_s: NotNegative = 0.2
    quantum_efficiency: Fraction = 0.5

    @property
    def dark_e(self) -> float:
        """Expected dark electrons per pixel and view."""
        return self.dark_current_e_per_s * self.exposure_s
