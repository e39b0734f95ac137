"""The record of what a capture will show, as `faintfield plan --json` prints it.

A number that is not known says why; an interval is that of the light, if this was estimated from a frame.
"""

from msgspec import Struct

from faintfield.pipelines.formats.results.noise_fit import Measured as Measured


class FeaturePrediction(Struct, frozen=True, kw_only=True):
    """A square of a size: the contrast from which it is visible, and how sure the depth of a black one is.

    Contrast is the difference of its light to that of its surroundings over the latter; a black square has 1.
    """

    side_px: float
    side_mm: Measured
    smallest_contrast: Measured
    depth_sigma_mm: Measured


class DepthPrediction(Struct, frozen=True, kw_only=True):
    """A plane at a depth, in the middle of the reference view.

    Attributes
    ----------
    depth_mm : float, optional
        None if no depth is known: its numbers are then those where all views see a sample.
    views : int
        Number of views that see it.
    seen_by_all_mm : (float, float), optional
        Width and height of the part that all views see.
    sigma_e : Measured
        Standard deviation of a sample of the unpenalised estimate, in electrons of all frames of a view, as the files
        of planes have them; samples are as wide as pixels.
    mm_per_px, blur_mm, depth_step_mm : Measured
        A pixel, and the standard deviation of the lens's blur, on the plane; the change of depth that moves a point by
        a pixel between the outermost views.
    """

    depth_mm: float | None
    views: int
    seen_by_all_mm: tuple[float, float] | None
    sigma_e: Measured
    mm_per_px: Measured
    blur_mm: Measured
    depth_step_mm: Measured
    features: list[FeaturePrediction]


class Alternative(Struct, frozen=True, kw_only=True):
    """One row of the table: another exposure, grid or number of frames, at the depth that the fewest views see.

    Attributes
    ----------
    snr : Measured
        Eq. (4) of one elemental image, all its frames added up.
    sigma_e : Measured
        As of a plane, but in electrons of one frame of the record's `exposure_s`, so that rows can be compared.
    smallest_contrast : Measured
        Of the first feature.
    scene_s, time_s : Measured
        Duration of the steps of the dark scene, and of the whole session without prompts.
    why_not : str, optional
        Why the rig cannot do this.
    """

    exposure_s: float
    rows: int
    columns: int
    frames_per_node: int
    snr: Measured
    sigma_e: Measured
    smallest_contrast: Measured
    scene_s: Measured
    time_s: Measured
    why_not: str | None = None


class PredictionRecord(Struct, frozen=True, kw_only=True):
    """Prediction of what a capture will show.

    Attributes
    ----------
    exposure_s, total_exposure_s : float
        Exposure of the first frame of the dark scene at a node, and of all together.
    noise_from, light_from : str
        Where noise and light are from.
    light_e, photons : Measured
        Expected electrons and photons per pixel in one such frame.
    pixel_share : float
        Part of the pixels that have the scarcest colour.
    snr, snr_linear : Measured
        Of one elemental image of a uniform object, by eq. (4) and eq. (7).
    vignetting : str, optional
        Why it is not known.
    rose_k : float
        Standard deviations by which a visible square stands out.
    wanted_sigma_e, cheapest : float and Alternative, optional
        What was asked for, and the alternative of the shortest session that reaches it.
    """

    rig: str
    rows: int
    columns: int
    pitch_mm: float
    exposure_s: float
    total_exposure_s: float
    frames_per_node: int
    noise_from: str
    read_noise_e: Measured
    dark_current_e_per_s: Measured
    light_from: str
    light_e: Measured
    photons: Measured
    pixel_share: float
    snr: Measured
    snr_linear: Measured
    vignetting: str | None
    rose_k: float
    depths: list[DepthPrediction]
    time_s: Measured
    alternatives: list[Alternative]
    wanted_sigma_e: float | None = None
    cheapest: Alternative | None = None
