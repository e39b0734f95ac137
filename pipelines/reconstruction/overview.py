"""A set at a glance: how dark it is, where its objects are, and its views as pictures."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray
from skimage.filters import threshold_li

from faintfield.calib.noise_model import Map
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.files import write_record, write_whole
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import Picture, contact_sheet, encoded, light_picture, white_level
from faintfield.pipelines.formats.results.figures import OVERVIEW_FILE, Brightness, Overview
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, in_units
from faintfield.pipelines.reconstruction.channels import checked_frame, lattice_noise, view_electrons
from faintfield.recon.metrics import photons_from_linear_snr, photons_from_moments, snr_from_powers
from faintfield.recon.threads import map_in_threads

# Mask of the objects in the reference view, beside a set's images if it is known.
OBJECT_REGION = "object_region.png"

INTEGRAL_IMAGE = "integral_image.png"
REFERENCE_VIEW = "reference_view.png"
NOISE_REFERENCE_VIEW = "noise_reference.png"
BRIGHT_VIEW = "bright_view.png"
REGION_OUTLINED = "object_region_outlined.png"

# Width of the sheet of all views, about as wide as the report.
_SHEET_WIDTH_PX = 1260

# Nodes of a grid per view of it; a sheet of views would show mostly gaps with more.
_MAX_NODES_PER_VIEW = 10

# Visible on white, grey and black.
_OUTLINE_RGB = (240, 120, 0)

type Region = NDArray[np.bool_]


def object_region(elemental_set: ElementalSet, path: Path | None = None) -> tuple[Region | None, str]:
    """Return the object region (row, column) of the reference view, None if it is not known, and its name.

    `path` is a mask to use instead of the set's own.
    """
    path = path or elemental_set.folder / OBJECT_REGION
    if path.is_file():
        return read_frame(path, elemental_set.settings.camera.size_px).pixels_dn > 127, "object region"
    light_e = bright_electrons(elemental_set)
    region = None if light_e is None else segmented(light_e, ~elemental_set.unusable)
    return (None, "whole view") if region is None else (region, "object region of the bright view")


def bright_electrons(elemental_set: ElementalSet) -> NDArray[np.float32] | None:
    """Return the electrons of the reference view in plenty of light (row, column), above dark; None if there is none.

    A colour camera gives the mean of the colours around each pixel, enough to tell where objects are.
    """
    if elemental_set.bright_view is None:
        return None
    path, exposure_s = elemental_set.bright_view
    frame = read_frame(path, elemental_set.settings.camera.size_px)
    pixels = frame.pixels_dn if frame.pixels_dn.ndim == 2 else frame.pixels_dn.mean(axis=2)
    light_e = elemental_set.noise.electrons(pixels) - np.asarray(
        elemental_set.noise.background_e(exposure_s), np.float32
    )
    mosaic = elemental_set.settings.camera.mosaic or frame.mosaic
    return np.asarray(light_e if mosaic is None else cv2.blur(light_e, (len(mosaic[0]), len(mosaic))), np.float32)


def segmented(light_e: NDArray[np.float32], usable: Region) -> Region | None:
    """Return the object region (row, column): above Li's threshold; None if the brightness is uniform.

    Li's threshold minimises the cross entropy between an image and its two levels, which weights a difference relative
    to the brightness, as suits photon counts. Otsu's weights its square, and misses the darker parts of objects.
    """
    level = light_e[usable]
    if not level.size or not np.ptp(level):
        return None
    region: Region = (light_e > threshold_li(level)) & usable
    return region if region.any() else None


def brightness(elemental_set: ElementalSet, region_path: Path | None = None) -> Brightness:
    """Measure the reference view of a set, all colours together; over the set's own object region by default."""
    return brightness_within(elemental_set, *object_region(elemental_set, region_path))


def brightness_within(elemental_set: ElementalSet, region: Region | None, name: str) -> Brightness:
    """Measure the reference view over a region (row, column) called `name`; over the whole view if it is None."""
    no_light_paths = elemental_set.noise_reference[: elemental_set.frames_per_view]
    has_reference = bool(no_light_paths)
    share = len(no_light_paths) / elemental_set.frames_per_view
    signal, reference = [], []
    for layout in elemental_set.layouts:
        images = view_electrons(elemental_set, layout, elemental_set.frame_paths[elemental_set.reference_view])
        no_light = view_electrons(elemental_set, layout, no_light_paths)
        for index, lattice in enumerate(layout.lattices):
            where = np.ones(lattice.shape, bool) if region is None else lattice.of(region)
            signal.append(images[index][0][where])
            noise = lattice_noise(elemental_set, lattice, None)
            dark_e = elemental_set.background_e(noise)
            if has_reference:
                no_light_e = no_light[index][0]
                reference.append((no_light_e if share == 1 else _as_whole_view(no_light_e, dark_e, share)).ravel())
            else:
                power = np.broadcast_to(
                    elemental_set.read_variance_e2(noise) + dark_e + np.square(dark_e), lattice.shape
                )
                reference.append(np.sqrt(power).ravel())
    noise_from = "noise reference" if has_reference else "noise model"
    return _figures(elemental_set, name, noise_from, np.concatenate(signal), np.concatenate(reference))


def _as_whole_view(no_light_e: NDArray[np.float32], dark_e: Map, share: float) -> NDArray[np.floating]:
    """Return electrons without light with the power that those of all frames of a view have, given a share of them.

    Means grow with the number of frames, deviations from them with its root. The mean of a pixel is its dark electrons
    by the noise model, `dark_e` in a view, and what all pixels share besides.
    """
    mean_e = share * dark_e
    mean_e = mean_e + np.mean(no_light_e - mean_e)
    return np.asarray(mean_e / share + (no_light_e - mean_e) / np.sqrt(share))


def _figures(
    elemental_set: ElementalSet, region: str, noise_from: str, signal_e: NDArray[Any], reference_e: NDArray[Any]
) -> Brightness:
    """Return the figures by eq. (4) and (7), given the electrons of the region and of the noise reference."""
    noise = elemental_set.noise
    read_noise_e = float(np.sqrt(elemental_set.frames_per_view * np.mean(np.square(noise.read_noise_e))))
    snr = snr_from_powers(signal_e, reference_e) if read_noise_e > 0 else None
    dark_e = float(np.mean(elemental_set.background_e(noise)))
    linear_e = moments_e = None
    if snr and snr > 0:
        # With a quantum efficiency of 1 the formulas for photons give electrons
        counting = {"quantum_efficiency": 1.0, "read_noise_e": read_noise_e}
        linear_e = photons_from_linear_snr(snr, **counting)
        moments_e = photons_from_moments(snr, dark_e=dark_e, **counting)
    efficiency = noise.quantum_efficiency
    return Brightness(
        region=region,
        noise_from=noise_from,
        snr=snr,
        electrons_linear=linear_e,
        electrons_from_moments=moments_e,
        mean_signal_e=float(np.mean(signal_e, dtype=np.float64)) - dark_e,
        photons_linear=linear_e / efficiency if efficiency and linear_e else None,
        photons_from_moments=moments_e / efficiency if efficiency and moments_e else None,
    )


def inspect_set(elemental_set: ElementalSet) -> tuple[Overview, dict[str, bytes]]:
    """Return the record of a set, and its pictures as PNG by file name; all its views share one grey scale.

    Every view is read, so that one that cannot be used is found before planes are made (InputError).
    """
    size_px, layout = elemental_set.settings.camera.size_px, elemental_set.layouts[0]
    reference_path = elemental_set.image_paths[elemental_set.reference_view]
    reference = checked_frame(elemental_set, reference_path, layout).pixels_dn
    black, white = grey_scale_dn(reference)
    grid = _grid(elemental_set)
    columns = grid[1] if grid else int(np.ceil(np.sqrt(len(elemental_set.settings.view))))
    small_px = max(_SHEET_WIDTH_PX // columns, 24)

    def shown(pixels_dn: NDArray[Any]) -> Picture:
        return light_picture(pixels_dn, white, black, tone_curve=elemental_set.units.tone_curve)

    def shrunk_view(path: Path) -> Picture:
        return shown(_every_nth(checked_frame(elemental_set, path, layout).pixels_dn, small_px))

    small = map_in_threads(shrunk_view, elemental_set.image_paths)
    pictures = {
        INTEGRAL_IMAGE: contact_sheet(small, columns),
        REFERENCE_VIEW: shown(reference),
    }
    if elemental_set.noise_reference:
        no_light = read_frame(elemental_set.noise_reference[0], size_px).pixels_dn
        pictures[NOISE_REFERENCE_VIEW] = shown(no_light)
    region, name = object_region(elemental_set)
    pictures |= _bright_views(elemental_set, region)
    noise, exposure_s = elemental_set.noise, elemental_set.settings.exposure_s
    record = Overview(
        units=elemental_set.units,
        set=elemental_set.folder.resolve().name,
        views=len(elemental_set.settings.view),
        grid=grid,
        poses=elemental_set.poses,
        size_px=elemental_set.settings.camera.size_px,
        exposure_s=exposure_s,
        frames_per_view=elemental_set.frames_per_view,
        read_noise_e=float(np.sqrt(np.mean(np.square(noise.read_noise_e)))),
        has_noise_reference=bool(elemental_set.noise_reference),
        quantum_efficiency=noise.quantum_efficiency,
        dark_e=float(np.mean(elemental_set.background_e(noise))),
        grey_scale_dn=(black, white),
        whole_dn=bool(np.issubdtype(reference.dtype, np.integer)),
        tone="srgb" if elemental_set.units.tone_curve else UNSET,
        brightness=brightness_within(elemental_set, region, name),
    )
    record = in_units(elemental_set, record)
    try:
        msgspec.json.decode(msgspec.json.encode(record), type=Overview)  # null stands for what is not finite
    except msgspec.ValidationError as failure:
        raise BadValue(
            f"{elemental_set.folder}: its light is not finite ({failure}); correct its noise model or object region"
        ) from failure
    return record, {name: encoded(picture, ".png") for name, picture in pictures.items()}


def write_overview(record: Overview, pictures: Mapping[str, bytes], out: Path) -> None:
    """Write the pictures of a set and `overview.json` into `out`."""
    for name, picture in pictures.items():
        write_whole(out / name, picture)
    write_record(out / OVERVIEW_FILE, record)


def _bright_views(elemental_set: ElementalSet, region: Region | None) -> dict[str, Picture]:
    light_e = bright_electrons(elemental_set)
    if light_e is None:
        return {}
    picture = light_picture(light_e, white_level(light_e))
    views = {BRIGHT_VIEW: picture}
    if region is not None:
        outlined = np.ascontiguousarray(np.dstack([picture] * 3))
        around, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(outlined, around, -1, _OUTLINE_RGB, max(max(region.shape) // 400, 1))
        views[REGION_OUTLINED] = outlined
    return views


def grey_scale_dn(reference_dn: NDArray[Any]) -> tuple[float, float]:
    """Return black and white of the grey scale of a set, which spans nearly all values of its reference view."""
    black, white = np.quantile(reference_dn, (0.001, 0.999))
    return float(black), float(max(white, black + 1))


def _every_nth(pixels: NDArray[Any], width_px: int) -> NDArray[Any]:
    """Return a frame reduced to about a width by leaving pixels out: averaging would reduce the noise."""
    step = max(round(pixels.shape[1] / width_px), 1)
    return pixels[step // 2 :: step, step // 2 :: step]


def _grid(elemental_set: ElementalSet) -> tuple[int, int] | None:
    """Return rows and columns of the grid, None unless every view states its node and most nodes have a view."""
    nodes = [view.node for view in elemental_set.settings.view if view.node is not None]
    if len(nodes) < len(elemental_set.settings.view):
        return None
    rows, columns = (int(np.ptp(places)) + 1 for places in zip(*nodes, strict=True))
    return (rows, columns) if rows * columns <= _MAX_NODES_PER_VIEW * len(nodes) else None
