"""The noise set: a folder of dark and flat frames with `noise.toml`, or those frames of a session."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from faintfield.calib.noise import Conditions
from faintfield.calib.noise.drift import dark_factor
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.frames import RAW_SUFFIXES, exif_exposure_s
from faintfield.pipelines.formats.limits import MAX_EXPOSURE_S, MAX_PERIOD_PX, sound_mosaic
from faintfield.pipelines.formats.reading import is_file
from faintfield.pipelines.formats.results.noise import NoiseFrame, TemperatureRange
from faintfield.pipelines.formats.toml_files import inside, read_toml, write_toml
from faintfield.rig.session.session import has_session, read_plan, taken_frames

FILE_NAME = "noise.toml"

# Largest number of photons per pixel; no pixel holds a thousandth of the electrons.
_MAX_PHOTONS = 1e9

# Range of temperatures, in kelvins, that counts as steady, and limits of those over which dark current doubles.
_STEADY_K, _MIN_DOUBLING_K, _MAX_DOUBLING_K = 0.5, 2.0, 30.0


class Region(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `[region]` table: pixels that see light and dark alike, as [first, end) of rows and columns."""

    rows: tuple[int, int]
    columns: tuple[int, int]


class NoiseSet(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """`noise.toml`; what follows the frames states what the image files do not.

    With `dark_current_doubling_k`, the kelvins over which dark current doubles, the dark current is that at the mean
    temperature of the frames.
    """

    format: Literal[1]
    frame: list[NoiseFrame]
    saturation_dn: float | None = None
    mosaic: tuple[str, ...] | None = None
    region: Region | None = None
    dark_current_doubling_k: float | None = None


def load_noise_set(folder: Path) -> tuple[Path, NoiseSet]:
    """Return a noise set and the folder that its file names are relative to: `noise.toml`, or a session's frames.

    Raises
    ------
    MissingFile, BadValue
        The file is missing, is not what it should be, or names a frame that is not there.
    """
    if has_session(folder) and not is_file(folder / FILE_NAME):
        return folder, _of_session(folder)
    path = folder if is_file(folder) else folder / FILE_NAME
    settings = read_toml(path, NoiseSet)
    folder = path.parent
    if not settings.frame:
        raise BadValue(f"{path}: names no frame; give a [[frame]] with file, kind and exposure_s for each")
    seen: set[Path] = set()
    for index, frame in enumerate(settings.frame):
        image = inside(folder, frame.file, f"{path}: frame[{index}].file")
        if not is_file(image):
            raise MissingFile(f"{image}: is named by {path} but missing; put it there or remove its entry")
        if image in seen:
            raise BadValue(f"{path}: {frame.file} is named twice; remove one of the entries")
        seen.add(image)
        _check_numbers(path, frame)
    doubling_k = settings.dark_current_doubling_k
    if doubling_k is not None and not _MIN_DOUBLING_K <= doubling_k <= _MAX_DOUBLING_K:
        raise BadValue(
            f"{path}: dark_current_doubling_k = {doubling_k}; give the kelvins over which dark current doubles, "
            f"{_MIN_DOUBLING_K:g} to {_MAX_DOUBLING_K:g}"
        )
    mosaic = settings.mosaic
    if mosaic is not None and not sound_mosaic(mosaic):
        raise BadValue(
            f'{path}: mosaic = {list(mosaic)}; give rows of equal length, at most {MAX_PERIOD_PX}, such as ["RG", "GB"]'
        )
    return folder, settings


def _of_session(folder: Path) -> NoiseSet:
    """Return the dark and flat frames of a session; each step of flats is a light level."""
    rig = read_plan(folder).rig
    light = [step.photons_per_s for step in rig.step]
    frames = [
        NoiseFrame(
            file=str(path.relative_to(folder)),
            kind=planned.kind,
            exposure_s=planned.exposure_s,
            temperature_c=taken.record.temperature_c,
            level=planned.sweep if planned.kind == "flat" else 0,
            photons=None if (photons_per_s := light[planned.step]) is None else photons_per_s * planned.exposure_s,
        )
        for planned, taken, path in taken_frames(folder)
        if planned.kind in ("dark", "flat")
    ]
    if not frames:
        raise BadValue(f"{folder}: the session has no dark frame yet; capture its dark and flat steps first")
    return NoiseSet(1, frames, saturation_dn=rig.checks.saturation_dn, mosaic=rig.mosaic)


def write_noise_set(folder: Path, settings: NoiseSet) -> None:
    """Write `noise.toml`; the images come first, so that a folder with this file is whole."""
    write_toml(folder / FILE_NAME, settings)


def group_frames(folder: Path, settings: NoiseSet) -> dict[Conditions, list[Path]]:
    """Return the frames by what they have in common, darks first, each kind by exposure.

    Raises
    ------
    BadValue
        A frame's exposure is neither stated nor in its EXIF.
    """
    groups: dict[Conditions, list[Path]] = {}
    warmth: dict[Conditions, list[float]] = {}
    for frame in settings.frame:
        path = folder / frame.file
        exposure_s = frame.exposure_s
        if exposure_s is None and path.suffix.lower() in RAW_SUFFIXES:
            exposure_s = exif_exposure_s(path)
        if exposure_s is None:
            raise BadValue(
                f"{path}: its exposure is neither stated nor in its EXIF, and is never guessed; add exposure_s to its "
                f"entry in {folder / FILE_NAME}"
            )
        # EXIF states exposures as ratios; the same setting must not differ in its last digit.
        level, photons = (frame.level, frame.photons) if frame.kind == "flat" else (0, None)
        conditions = Conditions(frame.kind, float(f"{exposure_s:.6g}"), level, photons)
        groups.setdefault(conditions, []).append(path)
        if frame.temperature_c is not None:
            warmth.setdefault(conditions, []).append(frame.temperature_c)
    groups = {_at_temperature(one, warmth, settings.dark_current_doubling_k): paths for one, paths in groups.items()}
    return dict(sorted(groups.items(), key=lambda item: (item[0].kind, item[0].exposure_s, item[0].level)))


def _at_temperature(
    conditions: Conditions, warmth: dict[Conditions, list[float]], doubling_k: float | None
) -> Conditions:
    """Return the conditions of a series with its dark current over that at the mean temperature of all frames."""
    if doubling_k is None or conditions not in warmth:
        return conditions
    reference_c = float(np.mean([temperature for series in warmth.values() for temperature in series]))
    factor = dark_factor(float(np.mean(warmth[conditions])), reference_c, doubling_k)
    return replace(conditions, dark_factor=factor)


def temperature_notes(settings: NoiseSet) -> tuple[TemperatureRange | None, list[str]]:
    """Return the range of the frames' temperatures, None without any, and warnings about it."""
    missing = [frame.file for frame in settings.frame if frame.temperature_c is None]
    known = [frame.temperature_c for frame in settings.frame if frame.temperature_c is not None]
    warnings = []
    if missing:
        warnings.append(
            f"{missing[0]}: no temperature is stated (nor for {len(missing) - 1} others); dark current changes by "
            "10 % per kelvin, so that the result holds only at the temperature of these frames"
        )
    if not known:
        return None, warnings
    if np.ptp(known) > _STEADY_K and settings.dark_current_doubling_k is not None:
        warnings.append(
            f"the temperature ran from {min(known):g} to {max(known):g} °C; dark current is taken to double every "
            f"{settings.dark_current_doubling_k:g} K, and is that at {np.mean(known):.1f} °C"
        )
    elif np.ptp(known) > _STEADY_K:
        warnings.append(
            f"the temperature ran from {min(known):g} to {max(known):g} °C, which moves the dark current by "
            f"{10 * np.ptp(known):.0f} %; let the camera settle before recording"
        )
    return TemperatureRange(float(np.mean(known)), min(known), max(known)), warnings


def _check_numbers(path: Path, frame: NoiseFrame) -> None:
    """Refuse impossible exposures, temperatures and photons."""
    for key, value, most in (
        ("exposure_s", frame.exposure_s, MAX_EXPOSURE_S),
        ("photons", frame.photons, _MAX_PHOTONS),
    ):
        if value is not None and not 0 <= value <= most:
            raise BadValue(f"{path}: {frame.file}: {key} = {value}; give a number from 0 to {most:g}")
    if frame.temperature_c is not None and not -273.15 <= frame.temperature_c < 200:
        raise BadValue(f"{path}: {frame.file}: temperature_c = {frame.temperature_c}; give degrees Celsius")
