"""Point clouds read back by a reader of their own: points, normals and colours in closed form."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.pipelines.errors import CannotWrite
from faintfield.pipelines.formats.exchange import ply
from faintfield.pipelines.formats.exchange.ply import write_points

SHAPE = (60, 80)
X, Y = (np.arange(80) - 39.5) / 100, (np.arange(60) - 29.5) / 100
TYPES = {"float": "<f4", "uchar": "u1"}


def _read(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return the columns of a binary PLY by the names that its header gives."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(next(line.split()[2] for line in lines if line.startswith("element vertex")))
    fields = [line.split()[1:] for line in lines if line.startswith("property")]
    table = np.frombuffer(body, [(name, TYPES[kind]) for kind, name in fields])
    assert len(table) == count
    return {name: table[name].astype(float) for _, name in fields}


def _vectors(points: dict[str, NDArray[np.float64]], names: str) -> NDArray[np.float64]:
    return np.column_stack([points[name] for name in names.split()])


def _plane(normal: NDArray[np.float64], distance_mm: float) -> NDArray[np.float64]:
    """Return the depth of the plane n · p = -distance along each ray (x, y, 1)."""
    rays = np.stack([*np.meshgrid(X, Y), np.ones(SHAPE)], axis=-1)
    return np.asarray(-distance_mm / (rays @ normal))


def _grey(level: int = 7) -> NDArray[np.uint8]:
    return np.full(SHAPE, level, np.uint8)


def test_points_of_slanted_plane_have_its_normal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply, "_ROWS", 7)
    normal = np.array([0.5, -0.3, -np.sqrt(1 - 0.25 - 0.09)])
    depth = _plane(normal, 400.0)
    assert write_points(tmp_path / "a.ply", depth, X, Y, _grey()) == depth.size
    points = _read(tmp_path / "a.ply")
    places = _vectors(points, "x y z")
    np.testing.assert_allclose(places @ normal, -400, rtol=1e-5)
    np.testing.assert_allclose(_vectors(points, "nx ny nz"), np.tile(normal, (len(places), 1)), atol=1e-4)
    np.testing.assert_allclose(places[1], [X[1] * depth[0, 1], Y[0] * depth[0, 1], depth[0, 1]], rtol=1e-6)


def test_normals_do_not_lean_across_steps(tmp_path: Path) -> None:
    depth = np.full(SHAPE, 500.0)
    depth[20:40, 30:50] = 400.0
    depth[25, 60] = np.nan
    write_points(tmp_path / "a.ply", depth, X, Y, _grey())
    np.testing.assert_allclose(
        _vectors(_read(tmp_path / "a.ply"), "nx ny nz"), np.tile([0, 0, -1], (depth.size - 1, 1)), atol=1e-6
    )


def test_known_samples_are_written_with_their_colours(tmp_path: Path) -> None:
    depth = np.full(SHAPE, np.nan)
    depth[3, 4], depth[50, 70] = 300.0, 600.0
    picture = np.zeros((*SHAPE, 3), np.uint8)
    picture[3, 4], picture[50, 70] = (1, 2, 3), (250, 20, 90)
    assert write_points(tmp_path / "a.ply", depth, X, Y, picture) == 2
    points = _read(tmp_path / "a.ply")
    np.testing.assert_array_equal(_vectors(points, "red green blue"), [(1, 2, 3), (250, 20, 90)])
    # A point by itself faces the camera
    towards = -_vectors(points, "x y z") / np.linalg.norm(_vectors(points, "x y z"), axis=1, keepdims=True)
    np.testing.assert_allclose(_vectors(points, "nx ny nz"), towards, atol=1e-6)
    write_points(tmp_path / "a.ply", depth, X, Y, _grey(9))
    np.testing.assert_array_equal(_vectors(_read(tmp_path / "a.ply"), "red green blue"), np.full((2, 3), 9))
    assert write_points(tmp_path / "a.ply", np.full(SHAPE, np.nan), X, Y, _grey()) == 0
    assert _read(tmp_path / "a.ply")["x"].size == 0


def test_impossible_clouds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\(60, 79\).* disagree in shape"):
        write_points(tmp_path / "a.ply", np.full(SHAPE, 5.0), X[1:], Y, _grey())
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite):
        write_points(tmp_path / "file" / "a.ply", np.full(SHAPE, 5.0), X, Y, _grey())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
