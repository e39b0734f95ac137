"""Corners of rendered boards against where they are, and of photographs against what is known of them."""

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.board import Board
from faintfield.calib.detection import BoardCorners, detect_all, detect_boards
from faintfield.pipelines.formats.frames import read_frame
from faintfield.rig.simulation.boards import SimulatedBoard, six_boards
from faintfield.rig.simulation.experiment import paper_experiment
from faintfield.rig.simulation.scene import render
from tests.simulated_boards import standing_board

EXPERIMENT = paper_experiment(1200, 900)
BOARD = Board("a", 8, 6, 40.0, 29.0, "DICT_5X5_1000", 100)
OTHER = Board("b", 8, 6, 40.0, 29.0, "DICT_5X5_1000", 300)

DATA = os.environ.get("FAINTFIELD_DATA")
needs_data = pytest.mark.skipif(not DATA, reason="FAINTFIELD_DATA is not set: no photographs to look for boards in")

type Rendered = tuple[NDArray[np.float32], list[NDArray[np.float64]]]


def rendered(boards: Sequence[Board], places: Sequence[SimulatedBoard], *, cut: bool = False) -> Rendered:
    """Return the light of boards, white 0.9, cut to the first of them or not, and where their corners are."""
    optics = EXPERIMENT.optics
    if cut:
        corners = places[0].seen(optics, np.zeros(6))
        side_px = np.nanmax(np.linalg.norm(np.diff(corners, axis=0), axis=1)[:4])
        left, top = np.maximum(np.floor(np.nanmin(corners, axis=0) - 1.6 * side_px), 0).astype(int).tolist()
        right, bottom = (np.nanmax(corners, axis=0) + 1.6 * side_px).astype(int).tolist()
        size_px = (min(right, optics.size_px[0]) - left, min(bottom, optics.size_px[1]) - top)
        optics = replace(optics, size_px=size_px, cx_px=optics.cx_px - left, cy_px=optics.cy_px - top)
    planes = [standing_board(board, place, EXPERIMENT) for board, place in zip(boards, places, strict=True)]
    light = next(render(planes, optics, np.zeros((1, 6)), samples_per_px=1)).light
    return light, [place.seen(optics, np.zeros(6)) for place in places]


@cache
def single(place: int) -> Rendered:
    return rendered([BOARD], [six_boards(5, 7, 40.0)[place]], cut=True)


def exposed(
    light: NDArray[np.float32], white_e: float, generator: np.random.Generator, frames: int = 1
) -> NDArray[np.float64]:
    photons = light * (white_e / 0.9 / EXPERIMENT.sensor.quantum_efficiency)
    images = [EXPERIMENT.sensor.expose(photons, 0.1, generator) for _ in range(frames)]
    return np.asarray(np.mean(images, axis=0), np.float64)


@pytest.mark.parametrize(
    ("white_e", "frames", "repeats", "detected", "rms_px"),
    [(9000.0, 1, 1, 1.0, 0.01), (27.0, 1, 2, 0.95, 0.1), (4.5, 16, 2, 0.85, 0.15)],
    ids=["bright", "dim", "average of few electrons"],
)
def test_corner_errors_are_those_stated(
    white_e: float, frames: int, repeats: int, detected: float, rms_px: float
) -> None:
    generator = np.random.default_rng(1)
    errors, sigmas, count = [], [], 0
    for place in (3, 4) * repeats:
        light, (truth,) = single(place)
        count += int(np.isfinite(truth[:, 0]).sum())
        for board in detect_boards(exposed(light, white_e, generator, frames), [BOARD]):
            errors.append(board.pixels - truth[board.corners])
            sigmas.append(np.repeat(board.sigma_px[:, np.newaxis], 2, axis=1))
    error_px = np.concatenate(errors)
    assert count == 70 * repeats
    assert len(error_px) >= detected * count
    assert np.sqrt(np.square(error_px).mean()) < rms_px
    if repeats == 1:
        assert np.abs(error_px.mean(axis=0)).max() < 0.01
    else:  # 280 numbers: three standard errors are 13 %
        ratio = error_px / np.concatenate(sigmas)
        assert np.sqrt(np.square(ratio).mean()) == pytest.approx(1.0, abs=0.15)


def test_scale_of_the_image_does_not_matter() -> None:
    light, _ = single(4)
    dim = detect_boards((light * 400 + 100).astype(np.uint16), [BOARD])[0]
    full = detect_boards((light * 60000).astype(np.uint16), [BOARD])[0]
    np.testing.assert_array_equal(dim.corners, full.corners)
    np.testing.assert_allclose(dim.pixels, full.pixels, atol=0.02)


@pytest.mark.parametrize("legacy", [False, True])
def test_older_layout_is_recognised(legacy: bool) -> None:
    picture = BOARD.opencv_board(legacy=legacy).generateImage((800, 600))
    (board,) = detect_boards(np.pad(picture, 60, constant_values=255), [BOARD])
    assert (board.legacy, len(board.corners)) == (legacy, 35)


def test_noise_holds_no_board() -> None:
    assert detect_boards(np.random.default_rng(1).normal(100, 5, (480, 640)), [BOARD]) == []


def test_parallel_detections_come_in_order() -> None:
    light, _ = single(4)
    counts = [
        [len(board.corners) for board in boards]
        for boards in detect_all([light, np.zeros_like(light), light], [BOARD], workers=2)
    ]
    assert counts == [[35], [], [35]]


PHOTOGRAPHED = Board("photographed", 5, 7, 40.0, 20.0, "DICT_6X6_250")


def photograph(name: str) -> BoardCorners:
    pixels = read_frame(Path(str(DATA)) / "charuco-photos" / f"{name}.jpg").pixels_dn
    (board,) = detect_boards(pixels.mean(axis=2) if pixels.ndim == 3 else pixels, [PHOTOGRAPHED])
    return board


@needs_data
def test_photographs_calibrate_as_well_as_documented() -> None:
    boards = [photograph(f"img_0{index}") for index in range(4)]
    assert [len(board.corners) for board in boards] == [24] * 4
    points = [PHOTOGRAPHED.corners_mm()[board.corners].astype(np.float32) for board in boards]
    pixels = [board.pixels.astype(np.float32) for board in boards]
    rms_px, *_ = cv2.calibrateCamera(points, pixels, (640, 480), None, None)
    assert rms_px <= 0.19


@needs_data
def test_occluded_photograph_shows_its_visible_corners() -> None:
    assert len(photograph("chocclusion_original").corners) == 16


def detected(light: NDArray[np.floating], boards: Sequence[Board] = (BOARD, OTHER)) -> dict[str, BoardCorners]:
    return {board.board: board for board in detect_boards(light, list(boards))}


def reduce_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let images be halved in which markers of 4 px remain."""
    monkeypatch.setattr("faintfield.calib.detection._MIN_MARKER_PX", 4.0)


def test_two_boards_at_full_and_half_size(monkeypatch: pytest.MonkeyPatch) -> None:
    places = [
        SimulatedBoard(5, 7, 40.0, np.array([0.2, 0.1, 0.05, -512.0, -128.0, 1600.0])),
        SimulatedBoard(5, 7, 40.0, np.array([-0.2, 0.5, 1.5, 230.0, -60.0, 1020.0])),
    ]
    light, truth = rendered([BOARD, OTHER], places)
    whole = detected(exposed(light, 9000.0, np.random.default_rng(3)))
    assert len(whole["b"].corners) == 35
    cut = detected(exposed(light[:, : int(truth[1][:, 0].mean())], 9000.0, np.random.default_rng(3)))["b"]
    assert 5 <= len(cut.corners) < 35
    for board in (whole["a"], whole["b"], cut):
        assert np.abs(board.pixels - truth["ab".index(board.board)][board.corners]).max() < 0.1
    reduce_images(monkeypatch)
    reduced = detected(exposed(light, 9000.0, np.random.default_rng(3)))
    for name, board in whole.items():
        again = reduced[name]
        assert set(board.corners) <= set(again.corners)
        assert again.markers >= board.markers
        apart = board.pixels - again.pixels[np.isin(again.corners, board.corners)]
        assert np.sqrt(np.square(apart).mean()) < 0.002


def test_second_look_restores_small_markers(monkeypatch: pytest.MonkeyPatch) -> None:
    small = SimulatedBoard(5, 7, 40.0, np.array([0.1, 0.2, 0.0, -80.0, -60.0, 1600.0]))
    light, _ = rendered([BOARD], [small])
    whole = detected(light, [BOARD])["a"]
    reduce_images(monkeypatch)
    reduced = detected(light, [BOARD])["a"]
    assert len(whole.corners) == len(reduced.corners) == 35
    monkeypatch.setattr("faintfield.calib.detection._search_again", lambda *_: [])
    assert detected(light, [BOARD])["a"].markers < reduced.markers == 24
