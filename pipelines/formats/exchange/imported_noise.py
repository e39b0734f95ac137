"""Noise of imported pictures: as stated, else as their views show it, else assumed; and which of these it is."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import NotIdentifiable
from faintfield.calib.homography import rotation_matrix
from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.exchange.tone import WHITE_DN, Tone, rounding_variance_dn2
from faintfield.pipelines.formats.frames import Frame, at_phase, mosaic_period, read_frame
from faintfield.pipelines.formats.results.noise_fit import Measured
from faintfield.pipelines.formats.sets.elemental_file import Noise, View
from faintfield.pipelines.formats.units import LightUnit

if TYPE_CHECKING:
    from faintfield.calib.noise.views import ViewNoise

# Views that are compared with two neighbours each, and the middle part of each view that is looked at, in px.
_COMPARED, _PART_PX = 8, 2048

# Share of blocks used. Compression leaves flat blocks cleaner than others, so all count.
_FLATTEST, _ALL = 0.3, 1.0

# What rounding to whole DN adds to the variance; the noise model adds it again.
_ROUNDING_DN2 = 1 / 12


@dataclass(frozen=True)
class StatedNoise:
    """The numbers of a sensor that a person stated; None where nobody did."""

    gain_dn_per_e: float | None = None
    read_noise_e: float | None = None
    offset_dn: float | None = None
    dark_current_e_per_s: float = 0.0
    quantum_efficiency: float | None = None

    def light_unit(self, tone: Tone) -> LightUnit:
        """Return the unit of light: electrons only if the gain is stated."""
        if self.gain_dn_per_e is not None:
            return "electrons"
        return "relative" if tone == "srgb" else "dn"

    def check_exposure(self, path: Path, exposure_s: float | None) -> None:
        """Refuse a dark current without the exposure over which it collects."""
        if exposure_s is None and self.dark_current_e_per_s:
            raise BadValue(
                f"{path}: states no exposure, without which {self.dark_current_e_per_s:g} dark electrons per second "
                "mean nothing; give --exposure-s"
            )


@dataclass(frozen=True)
class Pictures:
    """Pictures of a set, as written; the first as read, its tone curve, and whether compression changed values."""

    folder: Path
    views: Sequence[View]
    first: Frame
    tone: Tone
    lossy: bool

    @property
    def saturation_dn(self) -> float:
        """Value from which pixels of the set are saturated."""
        if self.tone == "srgb":
            return float(WHITE_DN)
        return self.first.saturation_dn or float(np.iinfo(self.first.pixels_dn.dtype).max)

    @property
    def bits(self) -> int:
        """Bits of a pixel as read."""
        return 8 * self.first.pixels_dn.itemsize


class NoiseOrigin(msgspec.Struct, frozen=True, omit_defaults=True):
    """Origin of gain and read noise of an imported set, in provenance.json.

    Attributes
    ----------
    how : {"stated", "estimated", "assumed"}
        By a person; from the residuals of neighbouring views; or neither, for the reason `why`.
    gain_dn, read_noise_dn : Measured, optional
        The estimates in DN: variance over mean, and standard deviation without light. Their intervals hold the scatter
        of blocks only.
    mean_dn, variance_dn2 : tuple of float
        The photon transfer curve that they were fitted to.
    blocks : int
        Number of blocks behind the curve.
    """

    how: Literal["stated", "estimated", "assumed"]
    why: str | None = None
    gain_dn: Measured | None = None
    read_noise_dn: Measured | None = None
    mean_dn: tuple[float, ...] = ()
    variance_dn2: tuple[float, ...] = ()
    blocks: int = 0


def complete_noise(stated_noise: StatedNoise, pictures: Pictures) -> tuple[Noise, NoiseOrigin]:
    """Return the noise of a set whose pictures are written, and where it comes from; say what nobody stated."""
    if stated_noise.offset_dn is None and pictures.first.black_dn is None:
        stated_noise = replace(stated_noise, offset_dn=0.0)

    def noise(gain_dn_per_e: float, read_noise_e: float, *, estimated: bool) -> Noise:
        return Noise(
            gain_dn_per_e,
            read_noise_e,
            stated_noise.offset_dn,
            stated_noise.dark_current_e_per_s,
            stated_noise.quantum_efficiency,
            pictures.saturation_dn,
            estimated,
        )

    if stated_noise.gain_dn_per_e is not None and stated_noise.read_noise_e is not None:
        return noise(stated_noise.gain_dn_per_e, stated_noise.read_noise_e, estimated=False), NoiseOrigin("stated")
    try:
        estimate = _estimate_noise(stated_noise, pictures)
    except NotIdentifiable as failure:
        gain, read_e = _assumed(stated_noise, pictures.tone)
        inform(
            f"gain and noise are not stated and cannot be estimated ({failure}); it is assumed that "
            f"{_describe_variance(gain, gain * read_e, pictures.tone)}; correct [noise] in elemental.toml if you know "
            "them"
        )
        return noise(gain, read_e, estimated=True), NoiseOrigin("assumed", str(failure))
    gain, read_dn = estimate.gain_dn.value, estimate.read_noise_dn.value
    inform(_describe_estimate(estimate, pictures.tone))
    read_e = (
        np.sqrt(max(read_dn**2 - _ROUNDING_DN2, 0.0)) / gain
        if stated_noise.read_noise_e is None
        else stated_noise.read_noise_e
    )
    return noise(gain, float(read_e), estimated=True), _origin(estimate)


def _assumed(stated_noise: StatedNoise, tone: Tone) -> tuple[float, float]:
    """Return gain and read noise in electrons where nothing tells them: of 8-bit pictures with a curve the rounding."""
    if tone == "srgb":
        dark, bright = rounding_variance_dn2(np.array([0.0, WHITE_DN]), tone, 8)
        gain = stated_noise.gain_dn_per_e or float(bright - dark) / WHITE_DN
        return gain, float(np.sqrt(dark)) / gain if stated_noise.read_noise_e is None else stated_noise.read_noise_e
    return stated_noise.gain_dn_per_e or 1.0, stated_noise.read_noise_e or 0.0


def _estimate_noise(stated_noise: StatedNoise, pictures: Pictures) -> "ViewNoise":
    """Return the noise that neighbouring views show."""
    from faintfield.calib.noise.views import compared_blocks, estimate_view_noise  # loads much that is used here only

    generator = np.random.default_rng(1)
    neighbours = _neighbours(pictures.views)
    blocks = []
    for three in progress(neighbours, "comparing views", len(neighbours)):
        frames = [read_frame(pictures.folder / pictures.views[index].image) for index in three]
        offset_dn = _offset_dn(frames[0], stated_noise)
        first, middle, last = (_colours(frame) - offset_dn for frame in frames)
        blocks.append(
            compared_blocks(
                (first, middle, last),
                saturation_dn=pictures.saturation_dn - float(np.max(offset_dn)),
                floor_dn=-float(np.min(offset_dn)),
                generator=generator,
            )
        )
    return estimate_view_noise(
        blocks,
        least_variance_dn2=lambda mean_dn: rounding_variance_dn2(
            mean_dn, pictures.tone, pictures.bits, pictures.first.saturation_dn
        ),
        flattest=_ALL if pictures.lossy else _FLATTEST,
        gain_dn=stated_noise.gain_dn_per_e,
    )


def _neighbours(views: Sequence[View]) -> list[tuple[int, int, int]]:
    """Return some views, spread over all, each between the two whose cameras are nearest to its own."""
    if len(views) < 3:
        return []
    poses = np.array([view.rt_cam_ref for view in views])
    centres = np.array([-rotation_matrix(pose).T @ pose[3:] for pose in poses])
    spread = np.unique(np.linspace(0, len(views) - 1, min(_COMPARED, len(views))).astype(int))
    found = []
    for index in spread.tolist():
        distance = np.linalg.norm(centres - centres[index], axis=1)
        distance[index] = np.inf
        one, other = np.argsort(distance, kind="stable")[:2].tolist()
        found.append((one, index, other))
    return found


def _colours(frame: Frame) -> NDArray[np.float32]:
    """Return the middle of a frame as (row, column, colour); the phases of a mosaic are colours of their own."""
    pixels = frame.pixels_dn
    if frame.mosaic is not None:
        period = mosaic_period(frame.mosaic)
        height, width = (length // step for length, step in zip(pixels.shape, period, strict=True))
        phases = [at_phase(pixels, phase, period)[:height, :width] for phase in np.ndindex(*period)]
        pixels = np.stack(phases, axis=-1)
    first = [max(0, (length - _PART_PX) // 2) for length in pixels.shape[:2]]
    part = pixels[first[0] :, first[1] :][:_PART_PX, :_PART_PX]
    return np.asarray(part.reshape(*part.shape[:2], -1), np.float32)


def _offset_dn(frame: Frame, stated_noise: StatedNoise) -> NDArray[np.float32]:
    """Return the offset of each colour: as stated, else the file's own black level, else 0."""
    own: Any = 0.0 if frame.black_dn is None else frame.black_dn if frame.mosaic is not None else frame.black_dn.mean()
    return np.asarray(own if stated_noise.offset_dn is None else stated_noise.offset_dn, np.float32).ravel()


def _describe_estimate(estimate: "ViewNoise", tone: Tone) -> str:
    """Return in words what was estimated, in the unit of the pictures."""
    return "gain and noise are not stated; estimated from the differences of neighbouring views, " + _describe_variance(
        estimate.gain_dn.value, estimate.read_noise_dn.value, tone
    )


def _describe_variance(gain_dn: float, read_noise_dn: float, tone: Tone) -> str:
    """Return in words how the variance follows from the light, in the unit of the pictures."""
    unit, words = (1.0, "DN") if tone == "linear" else (1.0 / WHITE_DN, "fractions of white")
    return f"the variance of a pixel is {gain_dn * unit:.3g} · light + {read_noise_dn * unit:.3g}², in {words}"


def _origin(estimate: "ViewNoise") -> NoiseOrigin:
    """Return the record of an estimate."""
    gain, read = (
        Measured(quantity.value, quantity.se, quantity.ci95) for quantity in (estimate.gain_dn, estimate.read_noise_dn)
    )
    curve = tuple(estimate.mean_dn.tolist()), tuple(estimate.variance_dn2.tolist())
    return NoiseOrigin("estimated", None, gain, read, *curve, estimate.blocks)
