"""Board sets of the simulated world: boards standing in the scene, photographed from every node."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.board import Board, black_rectangles_mm
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.sets.board_set import FILE_NAME, BoardEntry, BoardSetFile, ImageEntry
from faintfield.pipelines.formats.toml_files import write_toml
from faintfield.rig.plan import grid_nodes
from faintfield.rig.simulation.boards import SimulatedBoard, printed_board, six_boards
from faintfield.rig.simulation.experiment import SimulatedExperiment
from faintfield.rig.simulation.scene import TexturedPlane, render

# Reflectance of ink and of paper.
_BLACK, _WHITE = 0.05, 0.9

# White paper around the squares.
_MARGIN_MM = 12.0

# Standard deviation of the lens's blur at the detector, px; it also keeps sharp edges from aliasing.
_BLUR_PX = 0.6


def board_picture(board: Board, pitch_mm: float) -> NDArray[np.float32]:
    """Return the reflectance (row, column) of a printed board with a white margin, averaged over each sample."""
    margin = round(_MARGIN_MM / pitch_mm)
    height, width = (round(count * board.square_mm / pitch_mm) + 2 * margin for count in (board.rows, board.columns))
    ink = np.zeros((height, width), np.float32)
    for left, top, across, down in black_rectangles_mm(board) / pitch_mm + [margin, margin, 0, 0]:
        rows, columns = (slice(int(start), int(start + size) + 1) for start, size in ((top, down), (left, across)))
        ink[rows, columns] += np.outer(_covered(top, down, height)[rows], _covered(left, across, width)[columns])
    return np.asarray(_WHITE + (_BLACK - _WHITE) * np.clip(ink, 0, 1), np.float32)


def standing_board(
    board: Board, standing: SimulatedBoard, experiment: SimulatedExperiment, samples_per_px: float = 2.0
) -> TexturedPlane:
    """Return a printed board in the simulated scene, blurred by the lens."""
    px_mm = float(standing.rt_ref_board[5]) / experiment.optics.fx_px
    pitch_mm = px_mm / samples_per_px
    picture = cv2.GaussianBlur(board_picture(board, pitch_mm), (0, 0), _BLUR_PX * samples_per_px)
    edge_mm = round(_MARGIN_MM / pitch_mm) * pitch_mm + board.square_mm
    return printed_board(board.name, picture, pitch_mm, standing, (edge_mm, edge_mm))


def simulate_board_set(
    out: Path,
    experiment: SimulatedExperiment,
    poses_rt_cam_ref: NDArray[np.float64],
    boards: Sequence[Board],
    generator: np.random.Generator,
    *,
    white_e: float = 9000.0,
) -> None:
    """Write photographs of boards that stand at six places, one after another, from every node.

    The gantry returns to each node exactly, so that all sweeps share their poses (view, 6). White paper on the axis
    gives `white_e` electrons per pixel.
    """
    rows, columns = boards[0].corner_shape
    places = six_boards(rows, columns, boards[0].square_mm)
    nodes = grid_nodes(experiment.rows, experiment.columns)
    images = []
    for board, place in zip(boards, places, strict=False):
        plane = standing_board(board, place, experiment)
        views = render([plane], experiment.optics, poses_rt_cam_ref, samples_per_px=1)  # blurred: nothing to alias
        for node, view in zip(nodes, views, strict=True):
            name = f"{board.name}_r{node[0]}_c{node[1]}.tiff"
            photons = view.light * (white_e / _WHITE / experiment.sensor.quantum_efficiency)
            write_frame(out / name, experiment.sensor.expose(photons, experiment.exposure_s, generator))
            images.append(ImageEntry(name, node, boards.index(board)))
    entries = [BoardEntry(**{name: getattr(board, name) for name in BoardEntry.__struct_fields__}) for board in boards]
    write_toml(out / FILE_NAME, BoardSetFile(1, entries, images, experiment.pitch_mm))


def _covered(start: float, length: float, count: int) -> NDArray[np.float64]:
    """Return the share of each of `count` samples that lies between start and start + length."""
    edges = np.arange(count + 1)
    inside = np.clip(edges, start, start + length)
    return np.diff(inside)
