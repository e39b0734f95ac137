"""`faintfield darken`: a photon-starved set from a bright one."""

from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
from cyclopts import Parameter
from numpy.typing import NDArray

from faintfield.pipelines.arguments import Fraction, NotNegative, Positive, Seed
from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.files import building_folder, write_json
from faintfield.pipelines.formats.image_files import mask_picture, write_plane, write_png
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.sets.elemental_file import write_set
from faintfield.pipelines.formats.sets.elemental_set import NOISE_REFERENCE, ElementalSet, load_set
from faintfield.pipelines.reconstruction.brightness import brightness
from faintfield.pipelines.reconstruction.channels import ChannelLayout, channel_layouts, checked_frame, lattice_noise
from faintfield.pipelines.reconstruction.object_region import OBJECT_REGION
from faintfield.pipelines.simulation.exposures import stated_noise, write_exposures
from faintfield.recon.metrics import photons_from_linear_snr, photons_from_moments, signal_scale_for_snr
from faintfield.rig.simulation.sensor import SimulatedSensor

_PAPER = SimulatedSensor()

_FLAT = "flat.tiff"

# Names that no view may have.
_TAKEN = {Path(NOISE_REFERENCE).stem, Path(_FLAT).stem}


def darken(
    elemental_set: Annotated[Path, Parameter(name="SET")],
    out: Path,
    /,
    *,
    snr: Positive = 0.16,
    seed: Seed = 1,
    exposure_s: Positive = 0.1,
    read_noise_e: NotNegative = _PAPER.read_noise_e,
    dark_current_e_per_s: NotNegative = _PAPER.dark_current_e_per_s,
    quantum_efficiency: Fraction = _PAPER.quantum_efficiency,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Make a dark set from a bright one: the same views with a few photons per pixel.

    Each view is taken for its expected light, scaled so that eq. (4) gives the SNR asked for over the object region of
    the reference view (its brighter part, by Otsu's threshold), and exposed anew: photon, dark and read noise are
    drawn for the camera of the paper, or the one given. An exposure of nothing is written as the noise reference.

    Parameters
    ----------
    elemental_set
        Folder with elemental.toml of the bright set.
    out
        Folder to write.
    snr
        Of eq. (4).
    seed
        Of all chance.
    exposure_s
        Of each dark view.
    read_noise_e
        Standard deviation of the dark camera's read noise.
    dark_current_e_per_s
        Its dark electrons per pixel and second.
    quantum_efficiency
        Its electrons per photon.
    overwrite
        Replace an earlier set in OUT.
    """
    options = {name: value for name, value in locals().items() if name not in ("elemental_set", "out", "overwrite")}
    loaded = load_set(elemental_set)
    layouts = channel_layouts(loaded)
    sensor = SimulatedSensor(
        read_noise_e=read_noise_e, dark_current_e_per_s=dark_current_e_per_s, quantum_efficiency=quantum_efficiency
    )
    reference_light = _light(loaded, loaded.image_paths[loaded.reference_view], layouts)
    dark_e = dark_current_e_per_s * exposure_s
    region, scale = _region_and_scale(elemental_set, reference_light, snr, dark_e, read_noise_e)
    generator = np.random.default_rng(seed)
    with building_folder(out, replace_if="elemental.toml" if overwrite else None, reads=[loaded.folder]) as folder:
        _write_dark_views(loaded, layouts, folder, sensor, exposure_s, scale, generator)
        write_png(folder / OBJECT_REGION, mask_picture(region))
        photons = float(reference_light[region].mean()) * scale / quantum_efficiency
        record = provenance("darken", options, dict(loaded.input_hashes()))
        made = msgspec.structs.asdict(record) | {"scale_e": scale, "photons_on_object": photons}
        write_json(folder / "provenance.json", made)
    figures = brightness(load_set(out))
    known = {"quantum_efficiency": quantum_efficiency, "read_noise_e": read_noise_e}
    inform(f"{out}: SNR {figures.snr:.3f} measured for {snr:g} asked; {photons:.2f} photons per pixel on the object")
    return {
        "out": str(out),
        "views": len(loaded.image_paths),
        "snr": snr,
        "snr_measured": figures.snr,
        "photons_on_object": photons,
        "photons_linear": photons_from_linear_snr(snr, **known),
        "photons_from_moments": photons_from_moments(snr, dark_e=dark_e, **known),
        "scale_e": scale,
    }


def _region_and_scale(
    elemental_set: Path, light: NDArray[np.floating], snr: float, dark_e: float, read_noise_e: float
) -> tuple[NDArray[np.bool_], float]:
    """Return the object region (row, column) of the reference view, and the factor that makes its light dark."""
    region = object_region(light)
    if not region.any():
        raise BadValue(f"{elemental_set}: cannot be darkened: its reference view is black; is it the bright set?")
    try:
        return region, signal_scale_for_snr(light[region], snr, dark_e, read_noise_e)
    except ValueError as failure:
        raise BadValue(f"{elemental_set}: cannot be darkened: {failure}; is it the bright set?") from failure


def object_region(light: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the brighter part (row, column) of a view, separated from the darker by Otsu's threshold."""
    grey = light if light.ndim == 2 else light.mean(axis=2)
    top = float(np.quantile(grey, 0.999))
    levels = np.clip(grey * (255 / top) if top > 0 else grey, 0, 255).astype(np.uint8)
    threshold, _ = cv2.threshold(levels, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return np.asarray(levels > threshold)


def _light(loaded: ElementalSet, path: Path, layouts: list[ChannelLayout]) -> NDArray[np.float32]:
    """Return what a bright view says of the light: electrons above the dark level, never negative."""
    frame = checked_frame(loaded, path, layouts[0])
    light = np.zeros(frame.pixels_dn.shape, np.float32)
    for layout in layouts:
        for lattice in layout.lattices:
            noise = lattice_noise(loaded, lattice, frame)
            above = noise.electrons(lattice.of(layout.of(frame.pixels_dn))) - noise.background_e(
                loaded.settings.exposure_s
            )
            lattice.of(layout.of(light))[:] = np.maximum(above, 0)
    return light


def _names(loaded: ElementalSet) -> list[str]:
    """Return the file names of the dark views: those of the bright ones where that keeps them apart."""
    stems = [Path(view.image).stem for view in loaded.settings.view]
    if len({*stems, *_TAKEN}) < len(stems) + len(_TAKEN):
        stems = [f"view_{index:03d}" for index in range(len(stems))]
    return [f"{stem}.tiff" for stem in stems]


def _write_dark_views(
    loaded: ElementalSet,
    layouts: list[ChannelLayout],
    folder: Path,
    sensor: SimulatedSensor,
    exposure_s: float,
    scale_e: float,
    generator: np.random.Generator,
) -> None:
    """Expose every view anew and write the set; a mosaic stays one."""
    names = _names(loaded)
    with closing(progress(loaded.image_paths, "exposing views")) as paths:
        signal_e = (_light(loaded, path, layouts) * scale_e for path in paths)
        write_exposures(folder, names, signal_e, sensor, exposure_s, generator)
    camera = loaded.settings.camera
    if loaded.flat is not None:
        write_plane(folder / _FLAT, loaded.flat, pitch_mm=1.0)
        camera = msgspec.structs.replace(camera, flat=_FLAT)
    views = [msgspec.structs.replace(view, image=name) for view, name in zip(loaded.settings.view, names, strict=True)]
    settings = msgspec.structs.replace(
        loaded.settings, exposure_s=exposure_s, camera=camera, noise=stated_noise(sensor), view=views
    )
    write_set(folder, settings)
