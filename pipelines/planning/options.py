"""Options of `faintfield plan`, apart from the code that predicts: for help."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from faintfield.pipelines.arguments import Count, Fraction, NotNegative, Positive


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """Known light and camera of a capture, and the alternatives to compare.

    Parameters
    ----------
    light_e
        Light of the scene: electrons per pixel in one frame of the dark scene of the rig.toml.
    light_e_per_s
        The same, per second.
    flat
        A frame of even light as bright as the scene; its middle is taken.
    test_frame
        A frame of the scene, of any exposure; its mean is taken, with its interval.
    frame_exposure_ms
        Exposure of that frame; by default what its session, or else its file states.
    region_px
        Left column, upper row, width and height of the object in that frame; by default all of a test frame.
    depth_mm
        Depths of planes; by default those of the rig.toml.
    feature_px
        Sides of squares to be seen, in pixels; by default 10.
    feature_mm
        The same, in mm at the first depth.
    sigma_e
        Noise of a sample that is wanted, in electrons of one frame of the rig.toml's exposure.
    exposures_ms
        Exposures of a frame to compare; by default that of the rig.toml.
    grids
        Grids to compare, such as 3x3 5x5, with the rig.toml's pitch and centre; by default its own.
    frames
        Numbers of frames at a node to compare; by default those of the rig.toml, or 1 if their exposures differ.
    noise
        noise.json of the camera, or its folder; by default beside the rig.toml, or a simulated camera's own.
    read_noise_e
        Read noise, instead of the measured one.
    dark_current_e_per_s
        Dark electrons per pixel and second, instead of the measured ones.
    quantum_efficiency
        Electrons per photon, instead of the measured ones.
    geometry
        geometry.json of the camera, or its folder; by default beside the rig.toml.
    fx_px
        Focal length in pixels, instead of the measured one.
    blur_px
        Standard deviation of the lens's blur; by default none is assumed.
    rose_k
        Standard deviations by which a visible feature stands out of its surroundings (Rose's criterion).
    """

    light_e: Positive | None = None
    light_e_per_s: Positive | None = None
    flat: Path | None = None
    test_frame: Path | None = None
    frame_exposure_ms: Positive | None = None
    region_px: tuple[int, int, int, int] | None = None
    depth_mm: Annotated[list[Positive] | None, Parameter(consume_multiple=True)] = None
    feature_px: Annotated[list[Positive] | None, Parameter(consume_multiple=True)] = None
    feature_mm: Annotated[list[Positive] | None, Parameter(consume_multiple=True)] = None
    sigma_e: Positive | None = None
    exposures_ms: Annotated[list[Positive] | None, Parameter(consume_multiple=True)] = None
    grids: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None
    frames: Annotated[list[Count] | None, Parameter(consume_multiple=True)] = None
    noise: Path | None = None
    read_noise_e: NotNegative | None = None
    dark_current_e_per_s: NotNegative | None = None
    quantum_efficiency: Fraction | None = None
    geometry: Path | None = None
    fx_px: Positive | None = None
    blur_px: NotNegative | None = None
    rose_k: Positive = 5.0
