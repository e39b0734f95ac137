"""A dark set made from a bright one: the work of `faintfield darken`."""

from contextlib import closing
from pathlib import Path

import cv2
import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.files import check_free, require_room, write_json, writing_folder
from faintfield.pipelines.formats.frames import ChannelLayout
from faintfield.pipelines.formats.image_files import ONE_PIXEL, mask_picture, write_plane, write_png
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.sets.elemental_file import FILE_NAME, write_set
from faintfield.pipelines.formats.sets.elemental_set import NOISE_REFERENCE, ElementalSet, load_set
from faintfield.pipelines.formats.units import Units
from faintfield.pipelines.reconstruction.channels import checked_frame, lattice_noise
from faintfield.pipelines.reconstruction.overview import OBJECT_REGION, brightness
from faintfield.pipelines.simulation.options import DarkeningOptions
from faintfield.pipelines.simulation.synthetic_set import stated_noise, write_exposures
from faintfield.recon.metrics import photons_from_linear_snr, photons_from_moments, signal_scale_for_snr
from faintfield.rig.simulation.optics import SimulatedSensor

_FLAT = "flat.tiff"

# Largest share of noise in the power of what is measured as the light of the objects, and in the variance of the dark
# views as their noise model states it.
_MAX_NOISE_SHARE = 0.1

# Stems of files that stand beside the views: no view may have one.
_TAKEN_STEMS = {Path(NOISE_REFERENCE).stem, Path(_FLAT).stem}


class Darkened(msgspec.Struct, frozen=True):
    """A dark set that was made, and how dark it is; the result of `faintfield darken`."""

    out: str
    views: int
    snr: float
    snr_measured: float | None
    photons_on_object: float
    photons_linear: float
    photons_from_moments: float
    scale_e: float


def darken_set(folder: Path, out: Path, options: DarkeningOptions, *, overwrite: bool = False) -> Darkened:
    """Expose each view of a bright set anew with few photons, and write the dark set; BadValue if none has the SNR."""
    check_free(out, replace_if=FILE_NAME, overwrite=overwrite, reads=[folder])
    bright = load_set(folder)
    layouts = bright.layouts
    light, variance_e2 = _light(bright, bright.image_paths[bright.reference_view], layouts)
    region, scale_e = _region_and_scale(folder, light, options)
    _check_noise(folder, light[region], variance_e2[region], scale_e, options)
    size_bytes = len(bright.image_paths) * light.size * np.dtype(np.uint16).itemsize
    require_room(out, size_bytes, written_bytes=size_bytes)
    photons = float(light[region].mean()) * scale_e / options.quantum_efficiency
    with writing_folder(out, replace_if=FILE_NAME, overwrite=overwrite, reads=[folder]) as target:
        _write_dark_views(bright, layouts, target, options, scale_e)
        write_png(target / OBJECT_REGION, mask_picture(region))
        origin = provenance("darken", options, bright.input_hashes())
        record = origin.parts() | {"scale_e": scale_e, "photons_on_object": photons}
        write_json(target / "provenance.json", record)
    known = {"quantum_efficiency": options.quantum_efficiency, "read_noise_e": options.read_noise_e}
    return Darkened(
        out=str(out),
        views=len(bright.image_paths),
        snr=options.snr,
        snr_measured=brightness(load_set(out)).snr,
        photons_on_object=photons,
        photons_linear=photons_from_linear_snr(options.snr, **known),
        photons_from_moments=photons_from_moments(options.snr, dark_e=options.dark_e, **known),
        scale_e=scale_e,
    )


def _region_and_scale(
    folder: Path, light: NDArray[np.floating], options: DarkeningOptions
) -> tuple[NDArray[np.bool_], float]:
    region = _object_region(light)
    if not region.any():
        raise BadValue(f"{folder}: cannot be darkened: its reference view is black; is it the bright set?")
    try:
        return region, signal_scale_for_snr(light[region], options.snr, options.dark_e, options.read_noise_e)
    except ValueError as failure:
        raise BadValue(f"{folder}: cannot be darkened: {failure}; is it the bright set?") from failure


def _check_noise(
    folder: Path,
    light_e: NDArray[np.floating],
    variance_e2: NDArray[np.floating],
    scale_e: float,
    options: DarkeningOptions,
) -> None:
    """Refuse a set that is dark already, by light and noise of its objects: the noise would be darkened as light.

    Warn where so much of the noise remains that the noise model of the dark views does not describe them.
    """
    share = float(variance_e2.mean() / np.square(light_e).mean())
    if share > _MAX_NOISE_SHARE:
        raise BadValue(
            f"{folder}: is dark already: its noise is {min(share, 1):.0%} of the power that is measured as light of "
            f"its objects, at most {_MAX_NOISE_SHARE:.0%} may be; name the bright set, or the noise-free one of a "
            "simulation"
        )
    added = float(variance_e2.mean()) * scale_e**2
    stated = float(light_e.mean()) * scale_e + options.dark_e + options.read_noise_e**2
    if added > _MAX_NOISE_SHARE * stated:
        inform(
            f"warning: noise of {folder} adds {added / stated:.0%} to the variance of the dark views on their objects "
            f"and is missing in their noise model; at most {_MAX_NOISE_SHARE:.0%} may be: give a set of more light, or "
            "a lower --snr"
        )


def _object_region(light: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the brighter part (row, column) of a view, separated from the darker by Otsu's threshold."""
    grey = light if light.ndim == 2 else light.mean(axis=2)
    top = float(np.quantile(grey, 0.999))
    levels = np.clip(grey * (255 / top) if top > 0 else grey, 0, 255).astype(np.uint8)
    threshold, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return np.asarray(levels > threshold)


def _light(
    bright: ElementalSet, path: Path, layouts: list[ChannelLayout]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the light of a view in electrons, and the variance of its noise; both as its frame."""
    frame = checked_frame(bright, path, layouts[0])
    light = np.zeros(frame.pixels_dn.shape, np.float32)
    variance_e2 = np.zeros_like(light)
    for layout in layouts:
        for lattice in layout.lattices:
            noise = lattice_noise(bright, lattice, frame)
            electrons = noise.electrons(lattice.of(layout.of(frame.pixels_dn)))
            above = electrons - bright.background_e(noise)
            lattice.of(layout.of(light))[:] = np.maximum(above, 0)
            # Light that was computed has no read noise, and then no photon noise either
            if np.any(noise.read_noise_e):
                charge_e = np.maximum(electrons, 0)
                lattice.of(layout.of(variance_e2))[:] = charge_e + noise.read_variance_e2()
    return light, variance_e2


def _write_dark_views(
    bright: ElementalSet, layouts: list[ChannelLayout], folder: Path, options: DarkeningOptions, scale_e: float
) -> None:
    """Expose every view anew and write the set; a mosaic stays a mosaic.

    A dark view has the name of its bright view, unless two files would then have the same name.
    """
    sensor = SimulatedSensor(
        read_noise_e=options.read_noise_e,
        dark_current_e_per_s=options.dark_current_e_per_s,
        quantum_efficiency=options.quantum_efficiency,
    )
    generator = np.random.default_rng(options.seed)
    stems = [Path(view.image).stem for view in bright.settings.view]
    if len({*stems, *_TAKEN_STEMS}) < len(stems) + len(_TAKEN_STEMS):
        stems = [f"view_{index:03d}" for index in range(len(stems))]
    names = [f"{stem}.tiff" for stem in stems]
    with closing(progress(bright.image_paths, "exposing views")) as paths:
        signal_e = (_light(bright, path, layouts)[0] * scale_e for path in paths)
        write_exposures(folder, names, signal_e, sensor, options.exposure_s, generator)
    camera = bright.settings.camera
    if bright.flat is not None:
        write_plane(folder / _FLAT, bright.flat, ONE_PIXEL)
        camera = msgspec.structs.replace(camera, flat=_FLAT)
    views = [msgspec.structs.replace(view, image=name) for view, name in zip(bright.settings.view, names, strict=True)]
    settings = msgspec.structs.replace(
        bright.settings,
        exposure_s=options.exposure_s,
        units=Units(bright.units.depth, tone="srgb" if bright.units.tone_curve else UNSET),
        camera=camera,
        noise=stated_noise(sensor),
        view=views,
    )
    write_set(folder, settings)
