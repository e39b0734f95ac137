"""A plane sampled more finely than the detector, from views displaced by parts of a pixel."""

import numpy as np
from scipy.ndimage import map_coordinates

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.solver.cross_validation import cross_validated_weight
from faintfield.recon.solver.data_fit import DataFit, SceneProblem
from faintfield.recon.solver.initialization import smooth_start, universal_penalty_weight
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.pmlem import pmlem

SIZE = 48


def light(x: Image, y: Image) -> Image:
    """Bars that become narrower than two pixels, and a slanted edge; in pixels, exact at any point."""
    bars = np.where(np.sin(x * (0.9 + 0.012 * x)) > 0, 30.0, 5.0)
    return np.asarray(np.where(y > 12 + 0.3 * x, bars, np.where(y > 6, 12.0, 2.0)))


def reconstructed(images: ElementalImages, shifts: Image, pitch: float) -> Image:
    homographies = np.stack([np.eye(3)] * len(shifts))
    homographies[:, :2, 2] = shifts
    rays = np.stack(np.meshgrid(np.arange(float(SIZE)), np.arange(float(SIZE))), axis=-1)
    samples = int(SIZE / pitch)
    operator = PlaneOperator(homographies, rays, PlaneGrid((samples, samples), pitch, (0.0, 0.0)))
    start = smooth_start(operator, images)
    weight = cross_validated_weight(
        SceneProblem(operator, images), universal_penalty_weight(operator, images, start), Penalty()
    ).weight
    for iterate in pmlem(DataFit(operator, images, float(start.mean())), start, penalty_weight=weight):
        if iterate.certificate.distance < 0.01 or iterate.passes >= 25:
            break
    return iterate.plane


def test_a_finer_plane_shows_more_than_a_coarse_one_interpolated() -> None:
    generator = np.random.default_rng(4)
    shifts = generator.uniform(-0.5, 0.5, (49, 2))
    within = (np.arange(8) + 0.5) / 8 - 0.5  # a pixel takes the mean over its area
    offsets_y, offsets_x = np.meshgrid(within, within, indexing="ij")
    y, x = np.mgrid[:SIZE, :SIZE].astype(float)
    seen = np.stack(
        [light(x[..., None, None] + a + offsets_x, y[..., None, None] + b + offsets_y).mean((2, 3)) for a, b in shifts]
    )
    electrons = generator.poisson(seen) + generator.normal(0, 3.5, seen.shape)
    images = ElementalImages(electrons.astype(np.float32), 0.0, 3.5**2)
    coarse, fine = reconstructed(images, shifts, 1.0), reconstructed(images, shifts, 0.5)
    fine_y, fine_x = np.mgrid[8:80, 8:80] / 2
    truth = light(fine_x, fine_y)
    interpolated = map_coordinates(coarse, [fine_y, fine_x], order=3)
    error_of_coarse = np.mean((interpolated - truth) ** 2)
    error_of_fine = np.mean((fine[8:80, 8:80] - truth) ** 2)
    assert error_of_fine < 0.8 * error_of_coarse, (error_of_fine, error_of_coarse)
