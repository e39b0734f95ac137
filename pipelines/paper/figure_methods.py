"""The methods that figure 4 compares: to add one, add an entry to `METHODS`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec

import numpy as np

from faintfield.pipelines.formats.results.records import Method
from faintfield.pipelines.reconstruction.planes.solutions import PriorName, Settings
from faintfield.pipelines.reconstruction.planes.solve import solve
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.solver.initialization import back_projection


@dataclass(frozen=True)
class FigureMethod:
    """A method that makes a plane from dark views.

    Attributes
    ----------
    name, title : str
        Names in files, and on figures.
    plane : callable
        Takes the operator, the images and, if the method has one, a weight; returns the plane (row, column) in
        electrons.
    weights : tuple of float
        Weights to try if the method is given the best one, which only the true object tells and no experiment can
        find. Empty if the method finds its own weight.
    draws : int, optional
        Number of draws of the noise, fewer for methods that are slow and far from the best.
    """

    name: str
    title: str
    plane: Callable[..., Image]
    weights: tuple[float, ...] = ()
    draws: int | None = None


def _solved(
    method: Method,
    operator: PlaneOperator,
    images: ElementalImages,
    weight: float | None = None,
    prior: PriorName = "tv",
) -> Image:
    """Return the plane that `reconstruct --method` would write."""
    return solve(operator, images, method, Settings(penalty_weight=weight, prior=prior)).plane


def _clipped(operator: PlaneOperator, images: ElementalImages) -> Image:
    """Return the plane by a naive reading of eq. (2): negative pixels clipped at zero, read noise not modelled."""
    floor = np.maximum(images.electrons, 0)
    return _solved("pmlem-osl", operator, replace(images, electrons=floor, read_variance_e2=0.0))


def _tv_denoised(operator: PlaneOperator, images: ElementalImages, weight: float) -> Image:
    """Return the back-projection, denoised by total variation (Chambolle 2004)."""
    from skimage.restoration import denoise_tv_chambolle  # slow to load

    plane = back_projection(operator, images)
    # At the default tolerance it stops too early to compare weights
    return np.asarray(denoise_tv_chambolle(plane, weight=weight, eps=1e-5, max_num_iter=200), np.float32)


def _bm3d_denoised(operator: PlaneOperator, images: ElementalImages, weight: float) -> Image:
    """Return the back-projection, denoised by BM3D with a standard deviation of `weight` electrons."""
    import bm3d  # an extra

    return np.asarray(bm3d.bm3d(back_projection(operator, images), sigma_psd=weight), np.float32)


# The method that stands for the paper's, and the same with the best weight, which only the truth can tell.
OURS: Method = "pmlem"
BEST = "pmlem-best"

# Weights to try: β for PMLEM, electrons for the denoisers.
_PMLEM_WEIGHTS = tuple(np.geomspace(1.0, 3.2, 6).tolist())
_TV_WEIGHTS_E = tuple(np.geomspace(0.1, 1.6, 12).tolist())
_BM3D_WEIGHTS_E = tuple(np.geomspace(0.4, 1.2, 5).tolist())

# The first is the reference for the others.
METHODS = (
    FigureMethod("backprojection", "back-projection", back_projection),
    FigureMethod("tv", "back-projection + TV denoising, best weight", _tv_denoised, _TV_WEIGHTS_E),
    *(
        [FigureMethod("bm3d", "back-projection + BM3D, best weight", _bm3d_denoised, _BM3D_WEIGHTS_E, draws=2)]
        if find_spec("bm3d")
        else []
    ),
    FigureMethod("pmlem-clipped", "PMLEM, one-step-late, negative data clipped", _clipped, draws=2),
    FigureMethod("pmlem-osl", "PMLEM, one-step-late, weight from the noise", partial(_solved, "pmlem-osl"), draws=2),
    FigureMethod(OURS, "PMLEM, convergent, weight from held-out views", partial(_solved, OURS)),
    FigureMethod("pmlem-patches", "PMLEM, prior of patches", partial(_solved, OURS, prior="patches")),
    FigureMethod(BEST, "PMLEM, convergent, best weight", partial(_solved, OURS), _PMLEM_WEIGHTS),
)
