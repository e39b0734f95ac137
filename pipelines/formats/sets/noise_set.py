"""The noise set: a folder of dark and flat frames with `noise.toml`, or those frames of a session."""

from bisect import bisect_right
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from faintfield.calib.noise import Conditions
from faintfield.calib.noise.temperature import dark_factor
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.frames import RAW_SUFFIXES, exif_exposure_s
from faintfield.pipelines.formats.reading import is_file
from faintfield.pipelines.formats.results.noise import NoiseFrame, TemperatureRange
from faintfield.pipelines.formats.toml_files import inside, read_toml
from faintfield.pipelines.formats.units import MAX_EXPOSURE_S, MAX_PERIOD_PX, sound_mosaic
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.session.resume import present_settings
from faintfield.rig.session.session import PLAN, has_session, taken_frames
from faintfield.rig.simulation.lab import flat_photons_per_s

FILE_NAME = "noise.toml"

# Least and largest numbers; no pixel holds a thousandth of so many electrons.
_LIMITS = {
    "exposure_s": (0.0, MAX_EXPOSURE_S),
    "photons": (0.0, 1e9),
    "temperature_c": (-273.15, 200.0),
    "dark_current_doubling_k": (2.0, 30.0),
}

# Range of temperatures, in kelvins, that counts as steady.
_STEADY_K = 0.5

# Largest difference in kelvins between a dark frame and the scene, over which dark current changes by a fifth, and the
# number of files that a warning names.
_NEAR_SCENE_K, _MAX_NAMED = 2.0, 3


class Region(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `[region]` table: pixels that see light and dark alike.

    Parameters
    ----------
    rows, columns : (int, int)
        First row and the row after the last; first column and the column after the last.
    """

    rows: tuple[int, int]
    columns: tuple[int, int]


class NoiseSet(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """`noise.toml`: frames, and facts that the image files do not state.

    Parameters
    ----------
    format : 1
        Version of the format.
    frame : list of NoiseFrame
        Dark and flat frames.
    saturation_dn : float, optional
        Value from which a pixel is saturated.
    mosaic : tuple of str, optional
        Colour filters, row by row, such as ["RG", "GB"].
    region : Region, optional
        Part of the image that is measured; all of it by default.
    dark_current_doubling_k : float, optional
        Temperature difference in kelvin that doubles the dark current; with it, the dark current is that at the mean
        temperature of the frames.
    """

    format: Literal[1]
    frame: list[NoiseFrame]
    saturation_dn: float | None = None
    mosaic: tuple[str, ...] | None = None
    region: Region | None = None
    dark_current_doubling_k: float | None = None


@dataclass(frozen=True)
class FrameSeries:
    """The frames of a noise set or a session, checked, in series of one kind, exposure, light and temperature.

    File names in `settings` are relative to `folder`, and so is `described_in`, the file that names the frames. Darks
    come first, each kind by exposure; `warnings` are problems of the temperatures.
    """

    folder: Path
    settings: NoiseSet
    series: dict[Conditions, list[Path]]
    warnings: list[str]
    described_in: str = FILE_NAME

    @property
    def file_names(self) -> list[str]:
        """Names of all files that the series follow from."""
        return [self.described_in, *(frame.file for frame in self.settings.frame)]

    @property
    def temperature_c(self) -> dict[str, float]:
        """Temperature of each frame by its path, where it is stated."""
        return {
            str(self.folder / frame.file): frame.temperature_c
            for frame in self.settings.frame
            if frame.temperature_c is not None
        }

    @property
    def temperature_range(self) -> TemperatureRange | None:
        """Range of the temperatures, None if none is stated."""
        known = _known(self.settings.frame)
        return TemperatureRange(float(np.mean(known)), min(known), max(known)) if known else None


def load_noise_set(folder: Path) -> FrameSeries:
    """Return the series of a noise set, or of a session: `noise.toml` if there is one, else the session's frames.

    Raises
    ------
    MissingFile, BadValue
        A file is missing, is not what it should be, or names a frame that is not there or whose exposure is not known.
    """
    session = has_session(folder) and not is_file(folder / FILE_NAME)
    path = folder / PLAN if session else folder if is_file(folder) else folder / FILE_NAME
    settings, scene_c = _of_session(folder) if session else (_read_settings(path), [])
    warnings = [*_temperature_warnings(settings), *_scene_warnings(settings, scene_c)]
    return FrameSeries(path.parent, settings, group_frames(path, settings), warnings, path.name)


def _read_settings(path: Path) -> NoiseSet:
    page = "docs/how-to/measure_noise.md"
    remedy = f"name a session, or a folder with {FILE_NAME} ({page}); `faintfield import emva1288` makes one"
    settings = read_toml(path, NoiseSet, remedy=remedy)
    if not settings.frame:
        raise BadValue(f"{path}: names no frame; give a [[frame]] with file, kind and exposure_s for each")
    seen: set[Path] = set()
    for index, frame in enumerate(settings.frame):
        image = inside(path.parent, frame.file, f"{path}: frame[{index}].file")
        if not is_file(image):
            raise MissingFile(f"{image}: is named by {path} but missing; put it there or remove its entry")
        if image in seen:
            raise BadValue(f"{path}: {frame.file} is named twice; remove one of the entries")
        seen.add(image)
    for table in (*settings.frame, settings):
        for key, (least, most) in _LIMITS.items():
            value = getattr(table, key, None)
            if value is not None and not least <= value <= most:
                place = f"{path}: {table.file}" if isinstance(table, NoiseFrame) else path
                raise BadValue(f"{place}: {key} = {value}; give a number from {least:g} to {most:g}")
    mosaic = settings.mosaic
    if mosaic is not None and not sound_mosaic(mosaic):
        raise BadValue(
            f'{path}: mosaic = {list(mosaic)}; give rows of equal length, at most {MAX_PERIOD_PX}, such as ["RG", "GB"]'
        )
    return settings


def _of_session(folder: Path) -> tuple[NoiseSet, list[float]]:
    """Return the dark and flat frames of a session, each step of flats a light level; and temperatures of its scene."""
    rig, frames, scene_c = present_settings(folder), list[NoiseFrame](), list[float]()
    for planned, taken, path in taken_frames(folder):
        temperature_c = taken.record.temperature_c
        if planned.kind == "dark_scene" and temperature_c is not None:
            scene_c.append(temperature_c)
        if planned.kind not in ("dark", "flat"):
            continue
        photons_per_s = rig.step[planned.step].photons_per_s
        if planned.kind == "flat" and photons_per_s is None and isinstance(rig.camera, SimulatedSettings):
            photons_per_s = flat_photons_per_s(rig.camera)
        frame = NoiseFrame(
            file=path.relative_to(folder).as_posix(),
            kind=planned.kind,
            exposure_s=planned.exposure_s,
            temperature_c=temperature_c,
            level=planned.sweep if planned.kind == "flat" else 0,
            photons=None if photons_per_s is None else photons_per_s * planned.exposure_s,
        )
        frames.append(frame)
    if not frames:
        raise BadValue(f"{folder}: the session has no dark frame yet; capture its dark and flat steps first")
    return NoiseSet(1, frames, saturation_dn=rig.checks.saturation_dn, mosaic=rig.mosaic), scene_c


def group_frames(source: Path, settings: NoiseSet) -> dict[Conditions, list[Path]]:
    """Return the frames by what they have in common, darks first, each kind by exposure.

    Raises
    ------
    BadValue
        A frame's exposure is neither stated nor in its EXIF.
    """
    groups: dict[Conditions, list[NoiseFrame]] = {}
    for frame in settings.frame:
        path = source.parent / frame.file
        exposure_s = frame.exposure_s
        if exposure_s is None and path.suffix.lower() in RAW_SUFFIXES:
            exposure_s = exif_exposure_s(path)
        if exposure_s is None:
            raise BadValue(
                f"{path}: its exposure is neither stated nor in its EXIF, and is never guessed; add exposure_s to its "
                f"entry in {source}"
            )
        # EXIF states exposures as ratios; the same setting must not differ in its last digit.
        level, photons = (frame.level, frame.photons) if frame.kind == "flat" else (0, None)
        conditions = Conditions(frame.kind, float(f"{exposure_s:.6g}"), level, photons)
        groups.setdefault(conditions, []).append(frame)
    series = _by_temperature(groups, settings)

    def order(conditions: Conditions) -> tuple[str, float, int, float]:
        return conditions.kind, conditions.exposure_s, conditions.level, conditions.temperature_c or 0.0

    return {
        conditions: [source.parent / file for file in series[conditions]] for conditions in sorted(series, key=order)
    }


def _by_temperature(groups: dict[Conditions, list[NoiseFrame]], settings: NoiseSet) -> dict[Conditions, list[str]]:
    """Return the files of each series, darks of different temperatures apart, with what their dark current was."""
    known, of_darks = _known(settings.frame), _known(settings.frame, "dark")
    several, doubling_k = bool(of_darks) and np.ptp(of_darks) > _STEADY_K, settings.dark_current_doubling_k
    series: dict[Conditions, list[str]] = {}
    for conditions, frames in groups.items():
        for part in _split_by_temperature(frames) if several and conditions.kind == "dark" else [frames]:
            stated, own = _known(part), conditions
            if stated and several:
                own = replace(own, temperature_c=float(np.mean(stated)))
            if stated and doubling_k is not None:
                factor = dark_factor(float(np.mean(stated)), float(np.mean(known)), doubling_k)
                own = replace(own, dark_factor=factor)
            series.setdefault(own, []).extend(frame.file for frame in part)
    return series


def _split_by_temperature(frames: list[NoiseFrame]) -> list[list[NoiseFrame]]:
    """Return darks of one exposure, those of different temperatures apart, each part in the order of the frames.

    A part ends at a gap, or where a slow drift would make its dark current differ. Frames without a temperature are one
    part.
    """
    known = sorted(set(_known(frames)))
    firsts = known[:1]
    for before, after in pairwise(known):
        if after - before > _STEADY_K or after - firsts[-1] > _NEAR_SCENE_K:
            firsts.append(after)
    parts: dict[int, list[NoiseFrame]] = {}
    for frame in frames:
        part = 0 if frame.temperature_c is None else bisect_right(firsts, frame.temperature_c)
        parts.setdefault(part, []).append(frame)
    return list(parts.values())


def _known(frames: list[NoiseFrame], *kinds: str) -> list[float]:
    """Return the temperatures that are stated, of all frames or of some kinds."""
    known = [frame for frame in frames if not kinds or frame.kind in kinds]
    return [frame.temperature_c for frame in known if frame.temperature_c is not None]


def _temperature_warnings(settings: NoiseSet) -> list[str]:
    missing = [frame.file for frame in settings.frame if frame.temperature_c is None]
    known, warnings = _known(settings.frame), list[str]()
    if missing:
        warnings.append(
            f"{missing[0]}: no temperature is stated (nor for {len(missing) - 1} others); dark current changes by "
            "10 % per kelvin, so that the result holds only at the temperature of these frames"
        )
    if known and np.ptp(known) > _STEADY_K:
        percent, doubling_k = f"{10 * np.ptp(known):.0f} %", settings.dark_current_doubling_k
        effect = f", which moves the dark current by {percent}; let the camera settle before recording"
        if doubling_k is not None:
            effect = f"; dark current is taken to double every {doubling_k:g} K, and is that at {np.mean(known):.1f} °C"
        warnings.append(f"the temperature ran from {min(known):g} to {max(known):g} °C{effect}")
    return warnings


def _scene_warnings(settings: NoiseSet, scene_c: list[float]) -> list[str]:
    """Return a warning about the darks of a session that are warmer or colder than its dark scene.

    Frames whose temperature is not known are passed over.
    """
    away = [
        (frame.file, frame.temperature_c)
        for frame in settings.frame
        if scene_c and frame.kind == "dark" and frame.temperature_c is not None
        if abs(frame.temperature_c - float(np.median(scene_c))) > _NEAR_SCENE_K
    ]
    if not away:
        return []
    files, temperatures_c = zip(*away, strict=True)
    names = ", ".join(files[:_MAX_NAMED]) + (", …" if len(files) > _MAX_NAMED else "")
    darks = len(_known(settings.frame, "dark"))
    return [
        f"{len(away)} of {darks} dark frames are more than {_NEAR_SCENE_K:g} K away from the scene ({names}): they "
        f"have {min(temperatures_c):.1f} to {max(temperatures_c):.1f} °C, the {len(scene_c)} frames of the scene "
        f"{min(scene_c):.1f} to {max(scene_c):.1f} °C; "
        "take them again at the scene's temperature, as camera.settle_temperature_c makes sure of"
    ]
