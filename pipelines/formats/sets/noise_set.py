"""The noise set: a folder of dark and flat frames with `noise.toml`, or those frames of a session."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from faintfield.calib.noise import Conditions
from faintfield.calib.noise.fit.temperature import dark_factor
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.frames import RAW_SUFFIXES, exif_exposure_s
from faintfield.pipelines.formats.limits import MAX_EXPOSURE_S, MAX_PERIOD_PX, sound_mosaic
from faintfield.pipelines.formats.reading import is_file
from faintfield.pipelines.formats.results.noise import NoiseFrame, TemperatureRange
from faintfield.pipelines.formats.toml_files import inside, read_toml, write_toml
from faintfield.rig.session.changes import present_settings
from faintfield.rig.session.session import has_session, taken_frames

FILE_NAME = "noise.toml"

# Largest number of photons per pixel; no pixel holds a thousandth of the electrons.
_MAX_PHOTONS = 1e9

# Range of temperatures, in kelvins, that counts as steady, and limits of those over which dark current doubles.
_STEADY_K, _MIN_DOUBLING_K, _MAX_DOUBLING_K = 0.5, 2.0, 30.0

# Largest difference in kelvins between a dark frame and the scene, over which dark current changes by a fifth, and the
# number of files that a warning names.
_NEAR_SCENE_K, _MAX_NAMED = 2.0, 3


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
    rig = present_settings(folder)
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
    groups: dict[Conditions, list[tuple[Path, float | None]]] = {}
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
        groups.setdefault(conditions, []).append((path, frame.temperature_c))
    found = _by_temperature(groups, settings)
    return dict(sorted(found.items(), key=lambda item: _order(item[0])))


def _order(conditions: Conditions) -> tuple[str, float, int, float]:
    """Return what series are sorted by."""
    return conditions.kind, conditions.exposure_s, conditions.level, conditions.temperature_c or 0.0


def _by_temperature(
    groups: dict[Conditions, list[tuple[Path, float | None]]], settings: NoiseSet
) -> dict[Conditions, list[Path]]:
    """Return the series, darks of different temperatures apart, with what their dark current was."""
    known = [frame.temperature_c for frame in settings.frame if frame.temperature_c is not None]
    warmth = [
        frame.temperature_c for frame in settings.frame if frame.kind == "dark" and frame.temperature_c is not None
    ]
    several, doubling_k = bool(warmth) and np.ptp(warmth) > _STEADY_K, settings.dark_current_doubling_k
    found: dict[Conditions, list[Path]] = {}
    for conditions, frames in groups.items():
        for part in _alike(frames) if several and conditions.kind == "dark" else [frames]:
            of_part, own = [pixels for _, pixels in part if pixels is not None], conditions
            if of_part and several:
                own = replace(own, temperature_c=float(np.mean(of_part)))
            if of_part and doubling_k is not None:
                factor = dark_factor(float(np.mean(of_part)), float(np.mean(known)), doubling_k)
                own = replace(own, dark_factor=factor)
            found.setdefault(own, []).extend(path for path, _ in part)
    return found


def _alike(frames: list[tuple[Path, float | None]]) -> list[list[tuple[Path, float | None]]]:
    """Return darks of one exposure, those of different temperatures apart, each part in the order of the frames.

    A part ends at a gap, or where a slow drift would make its dark current differ. Frames without a temperature are one
    part.
    """
    known = sorted({frame for _, frame in frames if frame is not None})
    firsts: list[float] = []
    for index, warmth in enumerate(known):
        if index == 0 or warmth - known[index - 1] > _STEADY_K or warmth - firsts[-1] > _NEAR_SCENE_K:
            firsts.append(warmth)
    parts: dict[float | None, list[tuple[Path, float | None]]] = {}
    for path, frame in frames:
        first = None if frame is None else max(first for first in firsts if first <= frame)
        parts.setdefault(first, []).append((path, frame))
    return list(parts.values())


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


def scene_temperature_warnings(folder: Path, settings: NoiseSet) -> list[str]:
    """Return a warning about the darks of a session that are warmer or colder than its dark scene, if there are any.

    Frames whose temperature is not known are passed over, and so are sets that belong to no session.
    """
    if not has_session(folder) or is_file(folder / FILE_NAME):
        return []
    temperatures = [
        entry.record.temperature_c for frame, entry, _ in taken_frames(folder) if frame.kind == "dark_scene"
    ]
    scene = [found for found in temperatures if found is not None]
    if not scene:
        return []
    scene_c = float(np.median(scene))
    darks = [
        (frame.file, frame.temperature_c)
        for frame in settings.frame
        if frame.kind == "dark" and frame.temperature_c is not None
    ]
    away = [(file, found) for file, found in darks if abs(found - scene_c) > _NEAR_SCENE_K]
    if not away:
        return []
    low, high = min(found for _, found in away), max(found for _, found in away)
    names = ", ".join(file for file, _ in away[:_MAX_NAMED]) + (", …" if len(away) > _MAX_NAMED else "")
    return [
        f"{len(away)} of {len(darks)} dark frames are more than {_NEAR_SCENE_K:g} K away from the scene ({names}): "
        f"they have {low:.1f} to {high:.1f} °C, the {len(scene)} frames of the scene {min(scene):.1f} to "
        f"{max(scene):.1f} °C; "
        "take them again at the scene's temperature, as camera.settle_temperature_c makes sure of"
    ]


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
