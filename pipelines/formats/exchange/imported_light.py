"""Light of imported pictures: the curve of sRGB undone; noise as stated, else as the views show it, else assumed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import NotIdentifiable
from faintfield.calib.estimate import Estimate
from faintfield.calib.homography import rotation_matrix
from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import BadValue, WrongUsage
from faintfield.pipelines.formats.exchange.options import GridOptions, ImportOptions
from faintfield.pipelines.formats.frames import RAW_SUFFIXES, Frame, at_phase, mosaic_period, read_frame
from faintfield.pipelines.formats.reading import opened
from faintfield.pipelines.formats.sets.elemental_file import Noise, View
from faintfield.pipelines.formats.units import LightUnit

if TYPE_CHECKING:
    from faintfield.calib.noise.noise_from_views import ViewNoise

type Tone = Literal["linear", "srgb"]

# White of the 16-bit pictures that the curve is undone to.
WHITE_DN = 65535

# Bytes of a PNG within which a chunk on its tone lies: before the pixels.
_PNG_HEADER_BYTES = 4096

# Views that are compared with two neighbours each, and the middle part of each view that is looked at, in px.
_COMPARED, _PART_PX = 8, 2048

# Share of blocks used. Compression leaves flat blocks cleaner than others, so all count.
_FLATTEST, _ALL = 0.3, 1.0

# What rounding to whole DN adds to the variance; the noise model adds it again.
_ROUNDING_DN2 = 1 / 12


def tone_of(path: Path, first: Frame, options: ImportOptions | GridOptions) -> Tone:
    """Return the tone curve of pictures, as asked for; say what is assumed.

    By default it is that of sRGB for 8 bits, unless a PNG states a gamma of 1, and none for others.
    """
    if options.linear and options.srgb:
        raise WrongUsage("--linear and --srgb: pictures have one tone curve; give one of the two")
    if options.srgb and path.suffix.lower() in RAW_SUFFIXES:
        raise BadValue(f"{path}: is a raw file, which has no tone curve; leave --srgb out")
    if options.linear or options.srgb:
        return "srgb" if options.srgb else "linear"
    if first.pixels_dn.dtype != np.uint8 or _states_linear(path):
        return "linear"
    inform(
        "8-bit pictures are taken to have the tone curve of sRGB, which is undone; give --linear if their values are "
        "proportional to light"
    )
    return "srgb"


def _states_linear(path: Path) -> bool:
    """Return whether a file is a PNG whose gAMA chunk says that values are proportional to light."""
    if path.suffix.lower() != ".png":
        return False
    with opened(path) as file:
        header = file.read(_PNG_HEADER_BYTES).partition(b"IDAT")[0]
    at = header.find(b"gAMA")
    return at > 0 and b"sRGB" not in header and int.from_bytes(header[at + 4 : at + 8]) == 100_000


def without_curve(pixels: NDArray[Any], white: float | None = None) -> NDArray[np.uint16]:
    """Return pixels of 8 or 16 bits with the sRGB curve as 16-bit values proportional to light, white = 65535.

    White is the value `white` in the pixels, by default their largest possible one.
    """
    table = np.rint(_decoded(pixels.dtype.itemsize, white)).astype(np.uint16)
    return np.asarray(table[pixels])


def rounding_variance_dn2(
    mean_dn: NDArray[np.float64], tone: Tone, bits: int, white: float | None = None
) -> NDArray[np.float64]:
    """Return the variance that rounding to whole values gave to pixels of these means (…)."""
    if tone == "linear":
        return np.full(np.shape(mean_dn), 1 / 12)
    levels = _decoded(bits // 8, white)
    levels = levels[: int(np.argmax(levels)) + 1]  # white may be below the largest value
    steps = np.gradient(levels)
    return np.asarray(np.interp(mean_dn, levels, steps**2) / 12 + 1 / 12)


@cache
def _decoded(item_bytes: int, white: float | None) -> NDArray[np.float64]:
    """Return the light, white = 65535, of each value of 1 or 2 bytes, by IEC 61966-2-1."""
    values = 256**item_bytes
    value = np.minimum(np.arange(values) / (white or values - 1), 1.0)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4) * WHITE_DN


def light_unit(options: GridOptions, tone: Tone) -> LightUnit:
    """Return the unit of light: electrons only if the gain is stated."""
    if options.gain_dn_per_e is not None:
        return "electrons"
    return "relative" if tone == "srgb" else "dn"


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


class NoiseOrigin(msgspec.Struct, frozen=True, omit_defaults=True):
    """Origin of gain and read noise of an imported set, in provenance.json.

    Attributes
    ----------
    how : {"stated", "estimated", "assumed"}
        By a person; from the residuals of neighbouring views; or neither, for the reason `why`.
    gain_dn, read_noise_dn : Estimate, optional
        The estimates in DN: variance over mean, and standard deviation without light. Their intervals hold the scatter
        of blocks only.
    mean_dn, variance_dn2 : tuple of float
        The photon transfer curve that they were fitted to.
    blocks : int
        Number of blocks behind the curve.
    """

    how: Literal["stated", "estimated", "assumed"]
    why: str | None = None
    gain_dn: Estimate | None = None
    read_noise_dn: Estimate | None = None
    mean_dn: tuple[float, ...] = ()
    variance_dn2: tuple[float, ...] = ()
    blocks: int = 0


def complete_noise(options: GridOptions, pictures: Pictures) -> tuple[Noise, NoiseOrigin]:
    """Return the noise of a set whose pictures are written, and where it comes from; say what nobody stated."""
    if options.offset_dn is None and pictures.first.black_dn is None:
        options = replace(options, offset_dn=0.0)

    def noise(gain_dn_per_e: float, read_noise_e: float, *, estimated: bool) -> Noise:
        rest = options.offset_dn, options.dark_current_e_per_s, options.quantum_efficiency, pictures.saturation_dn
        return Noise(gain_dn_per_e, read_noise_e, *rest, estimated)

    if options.gain_dn_per_e is not None and options.read_noise_e is not None:
        return noise(options.gain_dn_per_e, options.read_noise_e, estimated=False), NoiseOrigin("stated")
    unknown = "gain and noise are not stated"
    try:
        estimate = _estimate_noise(options, pictures)
    except NotIdentifiable as failure:
        gain, read_e = _assumed(options, pictures.tone)
        inform(
            f"{unknown} and cannot be estimated ({failure}); it is assumed that "
            f"{_describe_variance(gain, gain * read_e, pictures.tone)}; correct [noise] in elemental.toml if you know "
            "them"
        )
        return noise(gain, read_e, estimated=True), NoiseOrigin("assumed", str(failure))
    gain_dn, read_dn = estimate.gain_dn.value, estimate.read_noise_dn.value
    assert gain_dn is not None, "a gain that cannot be estimated is refused"
    assert read_dn is not None, "so is a read noise"
    variance = _describe_variance(gain_dn, read_dn, pictures.tone)
    inform(f"{unknown}; estimated from the differences of neighbouring views, {variance}")
    read_e = float(np.sqrt(max(read_dn**2 - _ROUNDING_DN2, 0.0)) / gain_dn)
    if options.read_noise_e is not None:
        read_e = options.read_noise_e
    return noise(gain_dn, read_e, estimated=True), NoiseOrigin(
        "estimated",
        gain_dn=estimate.gain_dn,
        read_noise_dn=estimate.read_noise_dn,
        mean_dn=tuple(estimate.mean_dn.tolist()),
        variance_dn2=tuple(estimate.variance_dn2.tolist()),
        blocks=estimate.blocks,
    )


def _assumed(options: GridOptions, tone: Tone) -> tuple[float, float]:
    """Return gain and read noise in electrons where nothing tells them: of 8-bit pictures with a curve the rounding."""
    if tone == "srgb":
        dark, bright = rounding_variance_dn2(np.array([0.0, WHITE_DN]), tone, 8)
        gain = options.gain_dn_per_e or float(bright - dark) / WHITE_DN
        return gain, float(np.sqrt(dark)) / gain if options.read_noise_e is None else options.read_noise_e
    return options.gain_dn_per_e or 1.0, options.read_noise_e or 0.0


def _estimate_noise(options: GridOptions, pictures: Pictures) -> "ViewNoise":
    # Loads much that is used here only.
    from faintfield.calib.noise.noise_from_views import compared_blocks, estimate_view_noise

    first, saturation_dn = pictures.first, pictures.saturation_dn
    generator = np.random.default_rng(1)
    neighbours = _neighbours(pictures.views)
    blocks = []
    for three in progress(neighbours, "comparing views", len(neighbours)):
        frames = [read_frame(pictures.folder / pictures.views[index].image) for index in three]
        offset_dn = _offset_dn(frames[0], options)
        before, middle, after = (_colours(frame) - offset_dn for frame in frames)
        limits = {"saturation_dn": saturation_dn - float(np.max(offset_dn)), "floor_dn": -float(np.min(offset_dn))}
        blocks.append(compared_blocks((before, middle, after), **limits, generator=generator))
    return estimate_view_noise(
        blocks,
        least_variance_dn2=lambda mean_dn: rounding_variance_dn2(
            mean_dn, pictures.tone, 8 * first.pixels_dn.itemsize, first.saturation_dn
        ),
        flattest=_ALL if pictures.lossy else _FLATTEST,
        gain_dn=options.gain_dn_per_e,
    )


def _neighbours(views: Sequence[View]) -> list[tuple[int, int, int]]:
    """Return some views, spread over all, each between the two whose cameras are nearest to its own."""
    if len(views) < 3:
        return []
    poses = np.array([view.rt_cam_ref for view in views])
    centres = np.array([-rotation_matrix(pose).T @ pose[3:] for pose in poses])
    spread = np.unique(np.linspace(0, len(views) - 1, min(_COMPARED, len(views))).astype(int))
    neighbours = []
    for index in spread.tolist():
        distance = np.linalg.norm(centres - centres[index], axis=1)
        distance[index] = np.inf
        nearest, second = np.argsort(distance, kind="stable")[:2].tolist()
        neighbours.append((nearest, index, second))
    return neighbours


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


def _offset_dn(frame: Frame, options: GridOptions) -> NDArray[np.float32]:
    """Return the offset of each colour: as stated, else the file's own black level, else 0."""
    own: Any = 0.0 if frame.black_dn is None else frame.black_dn if frame.mosaic is not None else frame.black_dn.mean()
    return np.asarray(own if options.offset_dn is None else options.offset_dn, np.float32).ravel()


def _describe_variance(gain_dn: float, read_noise_dn: float, tone: Tone) -> str:
    """Return in words how the variance follows from the light, in the unit of the pictures."""
    unit, name = (1.0, "DN") if tone == "linear" else (1.0 / WHITE_DN, "fractions of white")
    return f"the variance of a pixel is {gain_dn * unit:.3g} · light + {read_noise_dn * unit:.3g}², in {name}"
