"""A model as COLMAP itself writes it, with where it sees points: `python tests/pipelines/colmap_by_pycolmap.py OUT`.

Needs pycolmap. What it wrote is kept in `colmap/` beside this file, so that tests need not.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pycolmap  # type: ignore[import-not-found]

SIZE_PX = (640, 480)
CAMERAS = {
    "SIMPLE_PINHOLE": [800.0, 322.5, 238.25],
    "PINHOLE": [800.0, 805.0, 322.5, 238.25],
    "SIMPLE_RADIAL": [800.0, 322.5, 238.25, -0.08],
    "RADIAL": [800.0, 322.5, 238.25, -0.08, 0.02],
    "OPENCV": [800.0, 805.0, 322.5, 238.25, -0.08, 0.02, 5e-4, -3e-4],
    "FULL_OPENCV": [800.0, 805.0, 322.5, 238.25, -0.08, 0.02, 5e-4, -3e-4, 0.01, 0.003, -0.002, 0.001],
}
POINTS = [[0.0, 0.0, 1.0], [0.3, -0.2, 1.2], [-0.35, 0.25, 0.9], [0.1, 0.3, 1.5]]


def write(folder: Path) -> None:
    """Write a model with one image per camera in text and in binary, and the points in COLMAP's own pixels."""
    generator, model, pixels = np.random.default_rng(1), pycolmap.Reconstruction(), {}
    for number, (kind, parameters) in enumerate(CAMERAS.items(), start=1):
        camera = pycolmap.Camera(
            camera_id=number, model=kind, width=SIZE_PX[0], height=SIZE_PX[1], params=np.array(parameters)
        )
        model.add_camera_with_trivial_rig(camera)
        axis = generator.normal(size=3)
        turn = pycolmap.Rotation3d(axis / np.linalg.norm(axis) * generator.uniform(0.05, 0.3))
        pose = pycolmap.Rigid3d(turn, generator.normal(size=3) * 0.05)
        name = f"some folder/{kind.lower()} r{number}.png"
        image = pycolmap.Image(
            name=name, camera_id=number, image_id=10 * number, keypoints=generator.uniform(0, 400, (number % 3, 2))
        )
        model.add_image_with_trivial_frame(image, pose)
        in_camera = [pose.rotation.matrix() @ np.array(point) + pose.translation for point in POINTS]
        pixels[name] = [camera.img_from_cam(point).tolist() for point in in_camera]
    for kind in ("text", "binary"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    model.write_text(str(folder / "text"))
    model.write_binary(str(folder / "binary"))
    content = {"pycolmap": pycolmap.__version__, "points": POINTS, "seen": pixels}
    (folder / "seen.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
