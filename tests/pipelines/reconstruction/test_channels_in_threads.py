"""Channels read by several threads: what one thread reads, in bounded memory, and over when a frame fails."""

import os
import threading
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.calib.noise_model import BentResponse, NoiseModel
from faintfield.pipelines.errors import UnreadableImage
from faintfield.pipelines.formats import frames
from faintfield.pipelines.formats.decoders import decode_tiff
from faintfield.pipelines.formats.frames import Frame, read_frame
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.reconstruction import channels
from faintfield.pipelines.reconstruction.channels import channel_layouts, keeping_frames, load_channel
from tests.patience import HANG_S
from tests.pipelines.conftest import Edit, SetMaker

BAYER = ["RG", "GB"]


@pytest.fixture(params=[1, 3])
def threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """The number of threads that read frames."""
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", request.param)
    return int(request.param)


def _pictures(views: int, shape: tuple[int, int] = (150, 34)) -> list[NDArray[np.uint16]]:
    return list(np.random.default_rng(20110919).integers(80, 1100, (views, *shape)).astype(np.uint16))


def _with_maps(elemental_set: ElementalSet) -> ElementalSet:
    """The set with a map for each number of the sensor, and a response that bends."""
    rng, shape = np.random.default_rng(7), elemental_set.settings.camera.size_px[::-1]
    noise = NoiseModel(
        offset_dn=rng.normal(100, 5, shape),
        gain_dn_per_e=rng.uniform(1.9, 2.1, shape),
        read_noise_e=rng.uniform(2, 4, shape),
        saturation_dn=999.5,
        response=BentResponse((rng.uniform(1e-5, 2e-5, shape), -1e-9), rng.uniform(500, 600, shape)),
    )
    return replace(elemental_set, noise=noise)


def _plain(elemental_set: ElementalSet) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Electrons of all views (view, row, column) by whole arrays, and where no frame is saturated."""
    noise, electrons, valid = elemental_set.noise, np.zeros(()), np.ones((), bool)
    assert noise.response is not None
    first, second = noise.response.bends_per_dn
    for frame in range(2):
        pixels = np.stack([tifffile.imread(elemental_set.frame_paths[view][frame]) for view in range(3)])
        signal = pixels - noise.offset_dn
        within = np.clip(signal, 0, noise.response.up_to_dn)
        slope = 1 + 2 * first * within + 3 * second * within**2
        charge = within * (1 + first * within + second * within**2) + (signal - within) * slope
        electrons, valid = electrons + charge / noise.gain_dn_per_e, valid & (pixels < 999.5)
    return electrons, valid


@pytest.mark.usefixtures("threads")
def test_colour_is_that_of_plain_arithmetic(make_set: SetMaker, edit: Edit) -> None:
    """Two frames a view, a map of everything, and more rows than are converted at a time."""
    folder = make_set(_pictures(6), camera={"mosaic": BAYER})

    def add_up_in_twos(settings: dict[str, Any]) -> None:
        settings["view"] = [settings["view"][k] | {"repeats": [f"view_{k + 3}.tiff"]} for k in range(3)]

    edit(folder, add_up_in_twos)
    elemental_set = _with_maps(load_set(folder))
    green = next(layout for layout in channel_layouts(elemental_set) if layout.name == "green")
    images = load_channel(elemental_set, green)
    assert images.valid is not None
    electrons, valid = _plain(elemental_set)
    for index, phase in enumerate([np.s_[:, 0::2, 1::2], np.s_[:, 1::2, 0::2]]):
        np.testing.assert_allclose(images.electrons[index::2], electrons[phase], rtol=3e-7, atol=1e-5)
        np.testing.assert_array_equal(images.valid[index::2], valid[phase])
    assert not images.valid.all()


class _CountedReader:
    """Reads frames, counts those that are begun and at work, and does something with each by its number."""

    def __init__(self, meanwhile: Callable[[int], object]) -> None:
        self.begun, self.at_work = 0, 0
        self._lock, self._meanwhile = threading.Lock(), meanwhile

    def __call__(self, path: Path, size_px: tuple[int, int]) -> Frame:
        with self._lock:
            self.begun += 1
            self.at_work += 1
        try:
            self._meanwhile(int(path.stem.removeprefix("view_")))
            return read_frame(path, size_px)
        finally:
            with self._lock:
                self.at_work -= 1


def _grey(make_set: SetMaker, views: int, shape: tuple[int, int] = (150, 34)) -> tuple[ElementalSet, Any]:
    elemental_set = load_set(make_set(_pictures(views, shape)))
    (layout,) = channel_layouts(elemental_set)
    return elemental_set, layout


def test_memory_is_that_of_frames_at_work(threads: int, make_set: SetMaker) -> None:
    shape, views = (300, 400), 24
    elemental_set, layout = _grey(make_set, views, shape)
    load_channel(elemental_set, layout)
    tracemalloc.start()
    try:
        images = load_channel(elemental_set, layout)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    pixels = shape[0] * shape[1]
    assert images.electrons.nbytes == 4 * views * pixels
    # A frame of two bytes a pixel, where it is saturated, and strips of float64
    assert peak - images.electrons.nbytes < threads * (5 * pixels + 300_000)


def test_first_damaged_frame_ends_reading_by_name(threads: int, make_set: SetMaker) -> None:
    elemental_set, layout = _grey(make_set, 40)
    for view in (4, 5, 6):
        os.truncate(elemental_set.image_paths[view], 3000)
    later = threading.Event()

    def fifth_fails_first(view: int) -> None:
        if view == 4 and threads > 1:
            assert later.wait(HANG_S)
        if view in (5, 6):
            later.set()

    counted = _CountedReader(fifth_fails_first)
    with pytest.raises(UnreadableImage, match=r"view_4\.tiff: cannot be decoded"):
        load_channel(replace(elemental_set, read_frame=counted), layout)
    assert counted.at_work == 0
    assert counted.begun <= 4 + threads


@pytest.mark.parametrize("threads", [3], indirect=True)
def test_interrupt_ends_all_threads(threads: int, make_set: SetMaker) -> None:
    elemental_set, layout = _grey(make_set, 40)
    together = threading.Barrier(threads)

    def interrupted(_: int) -> None:
        together.wait(HANG_S)
        if threading.current_thread() is threading.main_thread():
            together.abort()  # nobody waits for the main thread any longer
            raise KeyboardInterrupt

    counted = _CountedReader(interrupted)
    with pytest.raises(KeyboardInterrupt):
        load_channel(replace(elemental_set, read_frame=counted), layout)
    assert counted.at_work == 0
    assert counted.begun <= 6


@pytest.mark.parametrize(
    ("free_bytes", "most_kept", "decoded"),
    [(10**9, 256, 4), (0, 256, 12), (10**9, 3, 4 + 2 * 1)],  # the first colour, and one frame for each of the others
    ids=["with room", "without room on the disk", "few open files"],
)
def test_compressed_frames_are_decoded_once_for_all_colours(
    free_bytes: int, most_kept: int, decoded: int, make_set: SetMaker, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    folder, out, decoded_paths = make_set(_pictures(4), camera={"mosaic": BAYER}), tmp_path / "out", []
    for path in folder.glob("*.tiff"):
        tifffile.imwrite(path, tifffile.imread(path), compression="zlib", predictor=True)
    elemental_set = load_set(folder)
    layouts = channel_layouts(elemental_set)
    plain = [load_channel(elemental_set, layout).electrons for layout in layouts]

    def decode(file: Any, path: Path, *arguments: Any) -> Any:
        decoded_paths.append(path)
        return decode_tiff(file, path, *arguments)

    monkeypatch.setattr(channels, "disk_usage", lambda _: SimpleNamespace(free=free_bytes))
    monkeypatch.setattr(channels, "_MOST_KEPT", most_kept)
    monkeypatch.setattr(frames, "decode_tiff", decode)
    keeping = keeping_frames(elemental_set, out)
    for layout, electrons in zip(layouts, plain, strict=True):
        np.testing.assert_array_equal(load_channel(keeping, layout).electrons, electrons)
    assert len(decoded_paths) == decoded
    assert {*decoded_paths} == {*elemental_set.image_paths}
    assert not list(out.iterdir())  # the files have no name
    assert keeping_frames(keeping, out) is keeping
