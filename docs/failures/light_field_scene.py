"""Scenes of pictures at several depths, seen from a grid of 7 x 7 positions."""

from collections.abc import Callable
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

import faintfield

type Image = NDArray[np.float64]
type Place = tuple[float, float]

SIZE_PX, FOCAL_PX, STEP_MM = (128, 96), 160.0, 30.0
READ_NOISE_E = 2.0


@dataclass(frozen=True)
class Layer:
    """A picture (row, column) across the axis, as wide as the reference view, and continued beyond it."""

    picture: Image
    depth_mm: float

    def seen_from(self, camera_mm: Place) -> Image:
        """Return the light of each pixel (row, column) of a camera at a place."""
        place_mm = np.array(places_mm(camera_mm, self.depth_mm)[::-1])
        samples_per_mm = FOCAL_PX / self.depth_mm * self.picture.shape[1] / SIZE_PX[0]
        middle = np.array(self.picture.shape)[:, None, None] / 2
        return map_coordinates(self.picture, place_mm * samples_per_mm + middle, order=1, mode="reflect")


def places_mm(camera_mm: Place, depth_mm: float) -> tuple[Image, Image]:
    """Return x and y of the points at a depth that the pixels of a camera see."""
    rows, columns = np.mgrid[: SIZE_PX[1], : SIZE_PX[0]]
    x, y = (columns - (SIZE_PX[0] - 1) / 2) / FOCAL_PX, (rows - (SIZE_PX[1] - 1) / 2) / FOCAL_PX
    return x * depth_mm + camera_mm[0], y * depth_mm + camera_mm[1]


def window(camera_mm: Place, depth_mm: float) -> NDArray[np.bool_]:
    """Return the pixels of a camera that see an opening of 150 mm in a wall at a depth."""
    x_mm, _ = places_mm(camera_mm, depth_mm)
    return (x_mm > 0) & (x_mm < 150)


def nodes_mm() -> NDArray[np.float64]:
    """Return x and y of each position of the camera (node, 2)."""
    return STEP_MM * np.array([(column, row) for row in range(-3, 4) for column in range(-3, 4)], float)


def light_field(
    view: Callable[[Place], Image], photons: float = 20.0, poses_mm: NDArray[np.float64] | None = None
) -> faintfield.LightField:
    """Return the light field of a scene, given its light from each position; `poses_mm` are those that are stated."""
    rng = np.random.default_rng(1)
    light = photons * np.stack([view((x, y)) for x, y in nodes_mm()])
    images_e = rng.poisson(light) + rng.normal(0.0, READ_NOISE_E, light.shape)
    poses_rt_cam_ref = np.zeros((len(light), 6))
    poses_rt_cam_ref[:, 3:5] = -(nodes_mm() if poses_mm is None else poses_mm)
    centre = ((SIZE_PX[0] - 1) / 2, (SIZE_PX[1] - 1) / 2)
    lens = faintfield.Lens(SIZE_PX, FOCAL_PX, FOCAL_PX, *centre)
    noise = faintfield.NoiseModel(offset_dn=0.0, gain_dn_per_e=1.0, read_noise_e=READ_NOISE_E)
    return faintfield.LightField.from_arrays(images_e, poses_rt_cam_ref, lens, noise, reference=24)


def show(surface: faintfield.Surface, true_depth_mm: Image) -> None:
    """Draw picture, depth found, its sure part and true depth; print the share of sure depths that is right."""
    figure, axes = plt.subplots(1, 4, figsize=(14, 3.2), layout="constrained")
    axes[0].imshow(surface.picture, cmap="gray")
    axes[1].imshow(surface.depth, vmin=350, vmax=1000)
    axes[2].imshow(np.where(surface.sure, surface.depth, np.nan), vmin=350, vmax=1000)
    drawn = axes[3].imshow(true_depth_mm, vmin=350, vmax=1000)
    figure.colorbar(drawn, ax=axes[3], label="mm", fraction=0.036, pad=0.02)
    titles = "picture", "depth as found", f"depth where sure: {surface.sure.mean():.0%}", "true depth"
    for axis, title in zip(axes, titles, strict=True):
        axis.set(title=title, xticks=[], yticks=[], facecolor="0.5")
    right = np.abs(surface.depth / true_depth_mm - 1) < 0.02
    share = f"{right[surface.sure].mean():.0%} of these are right within 2 %" if surface.sure.any() else "none"
    print(f"sure: {surface.sure.mean():.0%} of the depths; {share}")
    plt.show()
