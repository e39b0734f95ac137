"""Scenes with true depth, rendered by a program that shares nothing with this one.

    python -m benchmarks.imaging.surface_scenes room OUT

renders a scene with Mitsuba 3 (https://www.mitsuba-renderer.org) from a grid of 7 × 7 nodes and writes a bright set,
to be darkened by `faintfield darken`, with true_depth_mm.tiff and true_picture.tiff of its reference view. Mitsuba
serves development only and stays out of .venv: make an environment for it alone (`python -m venv build/mitsuba`,
`build/mitsuba/bin/pip install mitsuba numpy scipy tifffile`) and call its Python. Nothing of faintfield is imported.

The scenes are `room`, `desk` and `hills`, and four whose depth cannot be known everywhere: most of `even` has no
texture; `mirror` and the ball of `glass` show what is elsewhere, while the true depth is theirs; and `repeated`
consists of squares that are all alike. A pane of glass has the depth of what shines through it.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

try:
    import mitsuba as mi
except ModuleNotFoundError:
    mi = None

from benchmarks.imaging.surface_models import SCENES, model, opaque

_WHITE_DN = 50000

# Standard deviations of a node's position along x and y, and of its rotation about each axis.
_POSITION_MM, _ROTATION_RAD = 0.3, 0.0035

_SEED = 5

type Picture = NDArray[np.float32]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera whose axis goes through the middle of its detector."""

    width: int
    height: int
    fx_px: float
    rays_per_px: int

    @property
    def centre_px(self) -> tuple[float, float]:
        """The principal point, where the first pixel's centre is (0, 0)."""
        return (self.width - 1) / 2, (self.height - 1) / 2


@dataclass(frozen=True)
class Node:
    """Pose of one view: the camera's centre (mm), and its rotation, from its axes to the reference's."""

    row: int
    column: int
    centre_mm: tuple[float, float, float]
    rotation: Rotation

    @property
    def image(self) -> str:
        """The view's file name."""
        return f"view_{self.row}_{self.column}.tiff"

    @property
    def rt_cam_ref(self) -> tuple[float, ...]:
        """The pose: Rodrigues rad and mm, from reference to camera."""
        to_camera = self.rotation.inv()
        return (*to_camera.as_rotvec().tolist(), *(-to_camera.apply(self.centre_mm)).tolist())


def grid(nodes: int, pitch_mm: float) -> list[Node]:
    """Return the nodes of a square grid in raster order, with normal errors of each but the one in the middle."""
    generator = np.random.default_rng(_SEED)
    middle, found = nodes // 2, []
    for row in range(nodes):
        for column in range(nodes):
            x_mm, y_mm = (column - middle) * pitch_mm, (row - middle) * pitch_mm
            rotation = Rotation.identity()
            if (row, column) != (middle, middle):
                dx_mm, dy_mm = _POSITION_MM * generator.standard_normal(2)
                x_mm, y_mm = x_mm + dx_mm, y_mm + dy_mm
                rotation = Rotation.from_rotvec(_ROTATION_RAD * generator.standard_normal(3))
            found.append(Node(row, column, (x_mm, y_mm, 0.0), rotation))
    return found


def sensor(camera: Camera, node: Node) -> Any:
    """Return a camera of Mitsuba at a node; Mitsuba's cameras look along z with x to the left and y up."""
    to_world = np.eye(4)
    to_world[:3, :3] = node.rotation.as_matrix() @ np.diag([-1.0, -1.0, 1.0])
    to_world[:3, 3] = node.centre_mm
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": "luminance"}
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(2 * np.degrees(np.arctan(camera.width / 2 / camera.fx_px))),
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f(to_world),
            "near_clip": 10.0,
            "far_clip": 1e5,
            "film": {**film, "rfilter": {"type": "box"}},
            "sampler": {"type": "stratified", "sample_count": camera.rays_per_px},
        }
    )


def render(scenes: Sequence[Any], camera: Camera, node: Node) -> Picture:
    """Return the light (row, column) of a view: the sum over scenes, each of which has one of the lamps."""
    camera_sensor, seed = sensor(camera, node), 100 * node.row + node.column
    return np.asarray(
        sum(
            np.array(mi.render(scene, sensor=camera_sensor, spp=camera.rays_per_px, seed=seed))[:, :, 0]
            for scene in scenes
        ),
        np.float32,
    )


def true_depth_mm(scene: Any, camera: Camera) -> Picture:
    """Return the depth (row, column) along the reference camera's axis at its pixel centres, NaN where nothing is."""
    depth_mm = np.full((camera.height, camera.width), np.nan, np.float32)
    cx_px, cy_px = camera.centre_px
    for row, column in np.ndindex(depth_mm.shape):
        ray = np.array([(column - cx_px) / camera.fx_px, (row - cy_px) / camera.fx_px, 1.0])
        length = float(np.linalg.norm(ray))
        hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(*(ray / length).tolist())))
        if hit.is_valid():
            depth_mm[row, column] = float(hit.t) / length
    return depth_mm


def settings_text(camera: Camera, nodes: Sequence[Node]) -> str:
    """Return `elemental.toml` of the bright set, whose unit is one electron and which has no noise of its own."""
    cx_px, cy_px = camera.centre_px
    lines = [
        "format = 1",
        "exposure_s = 1.0",
        f"reference_view = {len(nodes) // 2}",
        "",
        "[camera]",
        f"size_px = [{camera.width}, {camera.height}]",
        f"fx_px = {camera.fx_px}",
        f"fy_px = {camera.fx_px}",
        f"cx_px = {cx_px}",
        f"cy_px = {cy_px}",
        "",
        "[noise]",
        "offset_dn = 0.0",
        "gain_dn_per_e = 1.0",
        "read_noise_e = 0.0",
        "dark_current_e_per_s = 0.0",
    ]
    for node in nodes:
        pose = ", ".join(f"{number:.12g}" for number in node.rt_cam_ref)
        lines += ["", "[[view]]", f'image = "{node.image}"', f"node = [{node.row}, {node.column}]"]
        lines.append(f"rt_cam_ref = [{pose}]")
    return "\n".join(lines) + "\n"


def write_scene(name: str, out: Path, camera: Camera, nodes: Sequence[Node]) -> None:
    """Render a scene and write the set with its truth; few pixels of its reference view are above 50000 DN."""
    out.mkdir(parents=True)
    scenes = model(name)
    middle = len(nodes) // 2
    reference = render(scenes, camera, nodes[middle])
    scale = _WHITE_DN / float(np.quantile(reference, 0.999))
    for index, node in enumerate(nodes):
        view = reference if index == middle else render(scenes, camera, node)
        tifffile.imwrite(out / node.image, np.clip(np.rint(view * scale), 0, 65535).astype(np.uint16))
        print(f"{name}: view {index + 1} of {len(nodes)}", file=sys.stderr)
    tifffile.imwrite(out / "true_picture.tiff", reference * np.float32(scale))
    tifffile.imwrite(out / "true_depth_mm.tiff", true_depth_mm(opaque(name), camera))
    (out / "elemental.toml").write_text(settings_text(camera, nodes))


def main(argv: Sequence[str] | None = None) -> None:
    """Render the scene that is asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.imaging.surface_scenes", description=__doc__.splitlines()[0]
    )
    parser.add_argument("scene", choices=SCENES)
    parser.add_argument("out", type=Path, help="folder to write, which must not exist")
    parser.add_argument("--size-px", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--fx-px", type=float, help="focal length; by default 600 px at 640 px width")
    parser.add_argument("--rays", type=int, default=9, help="rays per pixel")
    parser.add_argument("--nodes", type=int, default=7, help="rows and columns of the grid, an odd number")
    parser.add_argument("--pitch-mm", type=float, default=50.0)
    arguments = parser.parse_args(argv)
    if mi is None:
        parser.error("mitsuba is not installed here; see the first lines of benchmarks/imaging/surface_scenes.py")
    if arguments.nodes % 2 == 0:
        parser.error(f"--nodes {arguments.nodes} has no node in the middle; give an odd number")
    if arguments.out.exists():
        parser.error(f"{arguments.out} exists; name another folder or remove it")
    mi.set_variant("scalar_rgb")
    width, height = arguments.size_px
    camera = Camera(width, height, arguments.fx_px or 600.0 * width / 640.0, arguments.rays)
    write_scene(arguments.scene, arguments.out, camera, grid(arguments.nodes, arguments.pitch_mm))


if __name__ == "__main__":
    main()
