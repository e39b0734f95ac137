"""Dark scenes of the examples: 49 views from a grid of 7 x 7 positions, with a read noise of 3.5 electrons."""

import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import gaussian_filter, shift
from skimage.data import camera
from skimage.transform import resize

from faintfield import (
    ElementalImages,
    Lens,
    LightField,
    NoiseModel,
    PlaneGrid,
    PlaneOperator,
    fronto_parallel_rt_ref_plane,
    plane_from_ray,
)

MARGIN = np.s_[8:-8, 8:-8]  # samples that most views see


def dark_scene() -> tuple[PlaneOperator, ElementalImages, np.ndarray]:
    """Return H, the images in electrons, and the true plane: a picture at 400 mm, about two electrons a pixel."""
    rng = np.random.default_rng(1)
    lens = Lens(size_px=(96, 96), fx_px=120.0, fy_px=120.0, cx_px=47.5, cy_px=47.5, distortion=(-0.05, 0.01))
    rows, columns = np.mgrid[-3:4, -3:4]
    poses_rt_cam_ref = np.zeros((49, 6))
    poses_rt_cam_ref[:, 3] = -6.1 * columns.ravel()
    poses_rt_cam_ref[:, 4] = -6.1 * rows.ravel()
    homographies = plane_from_ray(poses_rt_cam_ref, fronto_parallel_rt_ref_plane(depth_mm=400.0))
    grid = PlaneGrid(shape=(90, 90), pitch_mm=3.2, origin_mm=(-142.4, -142.4))
    operator = PlaneOperator(homographies, lens.rays(), grid, dtype=np.float64)

    truth_e = 4.0 * resize(camera(), grid.shape, anti_aliasing=True)
    noise_e = rng.normal(0.0, 3.5, operator.images_shape)
    dark = ElementalImages(rng.poisson(operator.forward(truth_e)) + noise_e, read_variance_e2=3.5**2)
    return operator, dark, truth_e


def dark_light_field() -> tuple[LightField, np.ndarray]:
    """Return 49 views of small beads 400 mm before the camera, on arrays without files, and the true plane."""
    rng = np.random.default_rng(2)
    lens = Lens(size_px=(96, 96), fx_px=120.0, fy_px=120.0, cx_px=47.5, cy_px=47.5)
    truth_e = np.zeros((96, 96))
    truth_e[tuple(rng.integers(4, 92, (2, 60)))] = rng.uniform(40.0, 100.0, 60)
    truth_e = gaussian_filter(truth_e, 1.0)

    # At 400 mm a point moves 2 px from one position of the camera to the next, so that views are shifted pictures.
    nodes = [(row, column) for row in range(-3, 4) for column in range(-3, 4)]
    poses_rt_cam_ref = np.zeros((49, 6))
    poses_rt_cam_ref[:, 3:5] = [(-20 / 3 * column, -20 / 3 * row) for row, column in nodes]
    views_e = np.stack([shift(truth_e, (-2 * row, -2 * column), order=0) for row, column in nodes])
    images_e = rng.poisson(views_e) + rng.normal(0.0, 3.5, views_e.shape)
    noise = NoiseModel(offset_dn=0.0, gain_dn_per_e=1.0, read_noise_e=3.5)
    return LightField.from_arrays(images_e, poses_rt_cam_ref, lens, noise), truth_e


def show(truth_e: np.ndarray, **planes: np.ndarray) -> None:
    """Draw planes beside the truth, each with its error."""
    _, axes = plt.subplots(1, 1 + len(planes), figsize=(3 * (1 + len(planes)), 3.6), layout="compressed")
    for axis, (title, plane) in zip(axes, {"truth": truth_e, **planes}.items(), strict=True):
        error = np.sqrt(np.mean((plane - truth_e)[MARGIN] ** 2))
        axis.set_title(title.replace("_", " ") + (f"\nerror {error:.2f} e" if error else ""))
        axis.imshow(plane, cmap="gray", vmin=0, vmax=4)
        axis.set(xticks=[], yticks=[])
    plt.show()
