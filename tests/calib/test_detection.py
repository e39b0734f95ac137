"""Corners of rendered boards against where they are, and of photographs against what is known of them."""

import os
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.board import Board
from faintfield.calib.detection import BoardCorners, detect_all, detect_boards, stretch
from faintfield.pipelines.formats.frames import read_frame
from faintfield.rig.simulation.boards import SimulatedBoard, six_boards
from faintfield.rig.simulation.experiment import paper_experiment
from faintfield.rig.simulation.scene import render
from tests.simulated_boards import standing_board

EXPERIMENT = paper_experiment(1200, 900)
BOARD = Board("a", 8, 6, 40.0, 29.0, "DICT_5X5_1000", 100)
OTHER = Board("b", 8, 6, 40.0, 29.0, "DICT_5X5_1000", 300)
PLACES = (3, 4)

DATA = os.environ.get("FAINTFIELD_DATA")
needs_data = pytest.mark.skipif(not DATA, reason="FAINTFIELD_DATA is not set: no photographs to look for boards in")


@cache
def rendered(place: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return the light of a view of a board, white 0.9, and where its corners are."""
    standing = six_boards(5, 7, 40.0)[place]
    plane = standing_board(BOARD, standing, EXPERIMENT)
    light = next(render([plane], EXPERIMENT.optics, np.zeros((1, 6)))).light
    return light, standing.seen(EXPERIMENT.optics, np.zeros(6))


def exposed(
    light: NDArray[np.float32], white_e: float, generator: np.random.Generator, frames: int = 1
) -> NDArray[np.float64]:
    photons = light * (white_e / 0.9 / EXPERIMENT.sensor.quantum_efficiency)
    taken = [EXPERIMENT.sensor.expose(photons, 0.1, generator) for _ in range(frames)]
    return np.asarray(np.mean(taken, axis=0), np.float64)


def found(white_e: float, frames: int = 1, repeats: int = 1) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Return errors (corner, 2), stated σ (corner,), and how many corners there are to find."""
    generator = np.random.default_rng(1)
    errors, sigmas, there = [], [], 0
    for place in PLACES * repeats:
        light, truth = rendered(place)
        there += int(np.isfinite(truth[:, 0]).sum())
        for seen in detect_boards(exposed(light, white_e, generator, frames), [BOARD]):
            errors.append(seen.pixels - truth[seen.corners])
            sigmas.append(seen.sigma_px)
    return np.concatenate(errors), np.concatenate(sigmas), there


def test_bright_corners_are_unbiased() -> None:
    errors, _, there = found(9000.0)
    assert len(errors) == there == 70
    assert np.abs(errors.mean(axis=0)).max() < 0.01
    assert np.sqrt(np.square(errors).mean()) < 0.01


def test_dim_corners() -> None:
    errors, sigmas, there = found(27.0, repeats=2)
    assert len(errors) >= 0.95 * there
    assert np.sqrt(np.square(errors).mean()) < 0.1
    assert np.sqrt(np.square(errors / sigmas[:, np.newaxis]).mean()) == pytest.approx(
        1.0, abs=0.15
    )  # 280 numbers: three standard errors are 13 %


def test_averaged_frames_of_a_few_electrons() -> None:
    errors, sigmas, there = found(4.5, frames=16, repeats=2)
    assert len(errors) >= 0.85 * there
    assert np.sqrt(np.square(errors).mean()) < 0.15
    assert np.sqrt(np.square(errors / sigmas[:, np.newaxis]).mean()) == pytest.approx(1.0, abs=0.15)


def test_detection_does_not_depend_on_the_scale_of_the_image() -> None:
    light, _ = rendered(4)
    dim = detect_boards((light * 400 + 100).astype(np.uint16), [BOARD])[0]
    full = detect_boards((light * 60000).astype(np.uint16), [BOARD])[0]
    np.testing.assert_array_equal(dim.corners, full.corners)
    np.testing.assert_allclose(dim.pixels, full.pixels, atol=0.02)


def test_several_boards_in_one_image_and_part_of_one() -> None:
    places = [
        SimulatedBoard(5, 7, 40.0, np.array([0.2, 0.1, 0.05, -320.0, -80.0, 1000.0])),
        SimulatedBoard(5, 7, 40.0, np.array([-0.2, 0.2, 0.0, 60.0, -60.0, 1020.0])),
    ]
    planes = [standing_board(board, place, EXPERIMENT) for board, place in zip((BOARD, OTHER), places, strict=True)]
    light = next(render(planes, EXPERIMENT.optics, np.zeros((1, 6)))).light
    seen = {one.board: one for one in detect_boards(light, [BOARD, OTHER])}
    truth = {"a": places[0].seen(EXPERIMENT.optics, np.zeros(6)), "b": places[1].seen(EXPERIMENT.optics, np.zeros(6))}
    for name, one in seen.items():
        assert np.isfinite(one.pixels).all()
        assert np.abs(one.pixels - truth[name][one.corners]).max() < 0.1
    assert len(seen["b"].corners) == 35
    cut = detect_boards(light[:, : int(truth["b"][:, 0].mean())], [BOARD, OTHER])
    partial = next(one for one in cut if one.board == "b")
    assert 5 <= len(partial.corners) < 35
    assert np.abs(partial.pixels - truth["b"][partial.corners]).max() < 0.1


def test_the_older_layout_is_recognised() -> None:
    picture = np.pad(BOARD.opencv_board(legacy=True).generateImage((800, 600)), 60, constant_values=255)
    (seen,) = detect_boards(picture, [BOARD])
    assert seen.legacy
    assert len(seen.corners) == 35
    (newer,) = detect_boards(np.pad(BOARD.opencv_board().generateImage((800, 600)), 60, constant_values=255), [BOARD])
    assert not newer.legacy


def test_nothing_is_found_in_noise() -> None:
    noise = np.random.default_rng(1).normal(100, 5, (480, 640))
    assert detect_boards(noise, [BOARD]) == []


def test_several_at_a_time_come_in_order() -> None:
    light, _ = rendered(4)
    blank = np.zeros_like(light)
    counts = [[len(one.corners) for one in seen] for seen in detect_all([light, blank, light], [BOARD], workers=2)]
    assert counts == [[35], [], [35]]


PHOTOGRAPHED = Board("photographed", 5, 7, 40.0, 20.0, "DICT_6X6_250")


def photograph(name: str) -> BoardCorners:
    pixels = read_frame(Path(str(DATA)) / "charuco-photos" / f"{name}.jpg").pixels_dn
    (seen,) = detect_boards(pixels.mean(axis=2) if pixels.ndim == 3 else pixels, [PHOTOGRAPHED])
    return seen


@needs_data
def test_photographs_calibrate_as_well_as_documented() -> None:
    seen = [photograph(f"img_0{index}") for index in range(4)]
    assert [len(one.corners) for one in seen] == [24] * 4
    points = [PHOTOGRAPHED.corners_mm()[one.corners].astype(np.float32) for one in seen]
    pixels = [one.pixels.astype(np.float32) for one in seen]
    rms_px, *_ = cv2.calibrateCamera(points, pixels, (640, 480), None, None)
    assert rms_px <= 0.19


@needs_data
def test_visible_corners_of_an_occluded_board_are_found() -> None:
    assert len(photograph("chocclusion_original").corners) == 16


@pytest.mark.parametrize("scale", [1.0, 4000.0])
def test_images_of_any_depth_are_stretched_from_black_to_white(scale: float) -> None:
    light = np.full((400, 600), 1.0, np.float32)
    light[:, 200:400], light[:, 400:] = 1.5, 2.0
    light[10:20, 10:20], light[380:390, 580:590] = 0.2, 3.0  # less than 0.2 % of the pixels
    found = stretch(scale * light)
    assert found.dtype == np.uint8
    assert found[200, [100, 300, 500]] == pytest.approx([0, 127.5, 255], abs=1)
    assert (found[15, 15], found[385, 585]) == (0, 255)


def both_ways(
    light: NDArray[np.floating], boards: list[Board], monkeypatch: pytest.MonkeyPatch
) -> tuple[dict[str, BoardCorners], dict[str, BoardCorners]]:
    """Return what is found in the image at full size, and with the first look at a half."""
    whole = {one.board: one for one in detect_boards(light, boards)}
    monkeypatch.setattr("faintfield.calib.detection._MIN_MARKER_PX", 4.0)
    return whole, {one.board: one for one in detect_boards(light, boards)}


def test_boards_are_found_as_well_in_a_reduced_image(monkeypatch: pytest.MonkeyPatch) -> None:
    depth_mm = 1600.0
    places = [
        SimulatedBoard(5, 7, 40.0, np.array([0.2, 0.1, 0.05, -0.32 * depth_mm, -0.08 * depth_mm, depth_mm])),
        SimulatedBoard(5, 7, 40.0, np.array([-0.2, 0.5, 1.5, 230.0, -60.0, 1020.0])),
    ]
    planes = [standing_board(board, place, EXPERIMENT) for board, place in zip((BOARD, OTHER), places, strict=True)]
    light = exposed(next(render(planes, EXPERIMENT.optics, np.zeros((1, 6)))).light, 9000.0, np.random.default_rng(3))
    whole, reduced = both_ways(light, [BOARD, OTHER], monkeypatch)
    assert len(whole["b"].corners) == 35
    assert whole.keys() <= reduced.keys()
    for name, one in whole.items():
        again = reduced[name]
        assert set(one.corners) <= set(again.corners)
        assert again.markers >= one.markers
        apart = one.pixels - again.pixels[np.isin(again.corners, one.corners)]
        assert np.sqrt(np.square(apart).mean()) < 0.002


def test_what_a_reduced_image_hides_is_looked_for_at_full_size(monkeypatch: pytest.MonkeyPatch) -> None:
    small = SimulatedBoard(5, 7, 40.0, np.array([0.1, 0.2, 0.0, -80.0, -60.0, 1600.0]))
    plane = standing_board(BOARD, small, EXPERIMENT)
    light = next(render([plane], EXPERIMENT.optics, np.zeros((1, 6)))).light
    whole, reduced = both_ways(light, [BOARD], monkeypatch)
    assert len(whole["a"].corners) == len(reduced["a"].corners) == 35
    monkeypatch.setattr("faintfield.calib.detection._second_looks", lambda *_: [])
    alone = detect_boards(light, [BOARD])
    assert alone[0].markers < reduced["a"].markers == 24
