"""The images of an elemental set in electrons, one stack per colour: what the solvers take."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from shutil import disk_usage
from tempfile import TemporaryFile
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.errors import BadValue, UnreadableImage, WrongBitDepth
from faintfield.pipelines.formats.frames import RAW_SUFFIXES, ChannelLayout, Frame, Lattice, read_frame
from faintfield.pipelines.formats.large_arrays import Allocate, mapped
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.threads import map_in_threads

# Share of the free disk that decoded frames may take; the rest is for results, and for electrons if memory is short.
SHARE_OF_DISK = 0.25

# Most frames that are kept: each needs an open file, of which a process may have about a thousand.
_MOST_KEPT = 256

# Maps of the noise model, a value per pixel or one for all.
_NOISE_MAPS = ("offset_dn", "gain_dn_per_e", "read_noise_e", "dark_current_e_per_s")


def channel_layouts(elemental_set: ElementalSet) -> list[ChannelLayout]:
    """Return the colours of a set, as its first frame has them.

    Parameters
    ----------
    elemental_set : ElementalSet
        The set, see `load_set`.

    Returns
    -------
    list of ChannelLayout
        Name and pixels of each colour: "grey" alone, or "red", "green" and "blue".

    Examples
    --------
    A simulated camera with a Bayer mosaic has two lattices of green pixels:

    >>> import tempfile
    >>> from pathlib import Path
    >>> from faintfield import SyntheticOptions, channel_layouts, load_set, simulate
    >>> options = SyntheticOptions(rows=2, columns=2, size_px=(64, 48), colour="bayer")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = simulate(Path(folder, "set"), options=options)
    ...     layouts = channel_layouts(load_set(Path(folder, "set")))
    >>> [(layout.name, len(layout.lattices)) for layout in layouts]
    [('red', 1), ('green', 2), ('blue', 1)]
    """
    return elemental_set.layouts


def keeping_frames(elemental_set: ElementalSet, folder: Path) -> ElementalSet:
    """Return a set that decodes each frame once: what took decoding is kept in files in a folder.

    The files have no name, so they disappear with the set, however the process ends. They take at most a quarter of
    the free disk, and are 256 at most; frames beyond that are decoded each time.
    """
    # A set is read once per colour, and again by searches and priors. Pixels are kept rather than electrons, as they
    # take half the room and serve all of these, and in files, as memory is for the solvers
    if elemental_set.read_frame is not read_frame:
        return elemental_set
    kept: dict[Path, Frame] = {}
    storing = Lock()

    def room_for(frame: Frame) -> NDArray[Any] | None:
        kept_bytes = sum(frame.pixels_dn.nbytes for frame in kept.values())
        folder.mkdir(parents=True, exist_ok=True)
        needed_bytes = kept_bytes + frame.pixels_dn.nbytes
        if len(kept) == _MOST_KEPT or needed_bytes > SHARE_OF_DISK * (kept_bytes + disk_usage(folder).free):
            return None
        with TemporaryFile(dir=folder) as file:
            return mapped(file, frame.pixels_dn.shape, frame.pixels_dn.dtype)

    def read(path: Path, size_px: tuple[int, int]) -> Frame:
        if path in kept:
            return kept[path]
        frame = read_frame(path, size_px)
        pixels = frame.pixels_dn
        if path.suffix.lower() not in RAW_SUFFIXES and path.stat().st_size >= pixels.nbytes:
            return frame  # uncompressed: it is read as fast from its own file
        with storing, suppress(OSError):  # without room it is decoded again
            if path not in kept and (stored := room_for(frame)) is not None:
                stored[:] = pixels
                kept[path] = replace(frame, pixels_dn=stored)
        return frame

    return replace(elemental_set, read_frame=read)


def load_channel(elemental_set: ElementalSet, layout: ChannelLayout, allocate: Allocate = np.empty) -> ElementalImages:
    """Read one colour of all views in electrons, each frame by one thread, directly into the stack.

    Parameters
    ----------
    elemental_set : ElementalSet
        The set, see `load_set`.
    layout : ChannelLayout
        The colour, see `channel_layouts`.
    allocate : callable, optional
        Makes the arrays as large as all views, given shape and type; by default numpy.empty.

    Returns
    -------
    ElementalImages
        Images (view, row, column) in electrons with their noise; of a mosaic, each view once per lattice of the colour.

    Raises
    ------
    WrongSize, WrongBitDepth, UnreadableImage
        A frame does not match the set.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from faintfield import SyntheticOptions, channel_layouts, load_channel, load_set, simulate
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = simulate(Path(folder, "set"), options=SyntheticOptions(rows=3, columns=3, size_px=(64, 48)))
    ...     elemental_set = load_set(Path(folder, "set"))
    ...     (grey,) = channel_layouts(elemental_set)
    ...     images = load_channel(elemental_set, grey)
    >>> images.electrons.shape
    (9, 48, 64)
    >>> round(images.read_variance_e2)  # e²
    12
    """
    phases = len(layout.lattices)
    views = len(elemental_set.settings.view)
    shape = layout.lattices[0].shape
    electrons = allocate((views * phases, *shape), np.float32)
    valid: NDArray[np.bool_] | None = None
    allocating = Lock()
    noise_of = _noise_by_frame(elemental_set, layout)

    def load(view: int) -> None:
        nonlocal valid
        part = slice(view * phases, (view + 1) * phases)
        over = _add_up(elemental_set, layout, noise_of, elemental_set.frame_paths[view], electrons[part])
        if over.any():
            with allocating:
                if valid is None:
                    valid = allocate(electrons.shape, np.bool_)
                    valid.fill(True)
            np.logical_not(over, out=valid[part])

    map_in_threads(load, range(views))
    noises = [noise_of(phase, None) for phase in range(phases)]
    return ElementalImages(
        electrons,
        background_e=_stacked([elemental_set.background_e(noise) for noise in noises], shape),
        read_variance_e2=_stacked([elemental_set.read_variance_e2(noise) for noise in noises], shape),
        valid=valid,
    )


def view_electrons(
    elemental_set: ElementalSet, layout: ChannelLayout, paths: Sequence[Path]
) -> list[tuple[NDArray[np.float32], NDArray[np.bool_]]]:
    """Return for each lattice the electrons (row, column) of all frames of a view, and where any frame is saturated.

    The sum has all the information that the single frames have, except for the shape of the read noise: the sum of
    Poisson counts is a Poisson count, and variances add.
    """
    sums = np.zeros((len(layout.lattices), *layout.lattices[0].shape), np.float32)
    over = _add_up(elemental_set, layout, _noise_by_frame(elemental_set, layout), paths, sums)
    return list(zip(sums, over, strict=True))


def _add_up(
    elemental_set: ElementalSet,
    layout: ChannelLayout,
    noise_of: Callable[[int, Frame | None], NoiseModel],
    paths: Sequence[Path],
    sums: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """Write the electrons of all frames of a view to `sums` (lattice, row, column); return where any is saturated."""
    over = np.zeros(sums.shape, bool)
    for number, path in enumerate(paths):
        frame = checked_frame(elemental_set, path, layout)
        pixels = layout.of(frame.pixels_dn)
        for index, lattice in enumerate(layout.lattices):
            noise, pixels_dn = noise_of(index, frame), lattice.of(pixels)
            if number == 0:
                noise.electrons(pixels_dn, sums[index])
            else:
                sums[index] += noise.electrons(pixels_dn)
            over[index] |= noise.saturated(pixels_dn)
    return over


def checked_frame(elemental_set: ElementalSet, path: Path, layout: ChannelLayout) -> Frame:
    """Read a frame, and check that it fits the camera and the noise model of the set."""
    frame = elemental_set.read_frame(path, elemental_set.settings.camera.size_px)
    found = frame.pixels_dn
    if (found.ndim == 3) != (layout.plane_of_colour is not None):
        kind = "colour" if found.ndim == 3 else "grey"
        raise UnreadableImage(
            f"{path}: is {kind}, unlike the set's first view; all views must be of one kind; export all alike"
        )
    if found.dtype not in (np.uint8, np.uint16) and not elemental_set.in_memory:
        raise WrongBitDepth(
            f"{path}: holds {found.dtype} pixels; elemental images are 8- or 16-bit whole numbers; export them so"
        )
    saturation_dn = elemental_set.noise.saturation_dn
    if found.dtype == np.uint8 and np.isfinite(saturation_dn) and saturation_dn > 255:
        raise WrongBitDepth(
            f"{path}: has 8 bits per pixel, but the noise model saturates at {saturation_dn:.0f} DN; "
            "export 16-bit images, or state the noise of the 8-bit ones (saturation_dn = 255)"
        )
    if elemental_set.offset_from_files and frame.black_dn is None:
        raise BadValue(f"{path}: brings no black level of its own; state noise.offset_dn in {elemental_set.folder}")
    return frame


def lattice_noise(elemental_set: ElementalSet, lattice: Lattice, frame: Frame | None) -> NoiseModel:
    """Return the noise model of a lattice; a raw frame has its own black level and saturation if none is stated."""
    values = {name: getattr(elemental_set.noise, name) for name in _NOISE_MAPS}
    maps: dict[str, Any] = {name: lattice.of(value) for name, value in values.items() if np.ndim(value) == 2}
    if elemental_set.noise.response is not None:
        maps["response"] = elemental_set.noise.response.part(lattice.of)
    return replace(elemental_set.noise, **maps | ({} if frame is None else _of_file(elemental_set, lattice, frame)))


def _of_file(elemental_set: ElementalSet, lattice: Lattice, frame: Frame) -> dict[str, Any]:
    """Return what a frame's own file says of the noise of a lattice and the set does not, by name."""
    own: dict[str, Any] = {}
    if elemental_set.offset_from_files and frame.black_dn is not None:
        black_dn = frame.black_dn[lattice.first] if frame.mosaic is not None else frame.black_dn.mean()
        own["offset_dn"] = float(black_dn)
    if not np.isfinite(elemental_set.noise.saturation_dn) and frame.saturation_dn is not None:
        own["saturation_dn"] = frame.saturation_dn
    return own


def _noise_by_frame(elemental_set: ElementalSet, layout: ChannelLayout) -> Callable[[int, Frame | None], NoiseModel]:
    # Checking the maps of a model takes longer than converting a frame by it, so frames that say the same share one
    noises = [lattice_noise(elemental_set, lattice, None) for lattice in layout.lattices]
    known: dict[tuple[int, tuple[tuple[str, float], ...]], NoiseModel] = {}

    def noise_of(index: int, frame: Frame | None) -> NoiseModel:
        own = {} if frame is None else _of_file(elemental_set, layout.lattices[index], frame)
        key = (index, tuple(own.items()))
        if key not in known:
            known[key] = replace(noises[index], **own)
        return known[key]

    return noise_of


def _stacked(parts: list[Any], shape: tuple[int, int]) -> Any:
    """Return one number if all lattices share it, else the maps (lattice, row, column)."""
    if all(np.ndim(part) == 0 and part == parts[0] for part in parts):
        return float(parts[0])
    return np.stack([np.broadcast_to(part, shape) for part in parts]).astype(np.float32)
