"""The reconstructions that figure 4 compares, in one list; a further one is a further entry of `METHODS`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec

import numpy as np

from faintfield.pipelines.formats.results.records import Method
from faintfield.pipelines.reconstruction.planes import Settings, solve
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.plane import PlaneOperator
from faintfield.recon.solver.starts import back_projection


@dataclass(frozen=True)
class FigureMethod:
    """One way from dark views to a plane.

    Attributes
    ----------
    name, title : str
        In files, and on figures.
    plane : callable
        Of operator, images and, where the method has one, a weight; gives the plane (row, column) in electrons.
    weights : tuple of float
        The weights that are tried where the best one is found from the true object, which no experiment can do; empty
        where the method finds its own.
    draws : int, optional
        Only the first so many draws of the noise, for a method that is slow and far from the one it is compared with.
    """

    name: str
    title: str
    plane: Callable[..., Image]
    weights: tuple[float, ...] = ()
    draws: int | None = None


def _solved(method: Method, operator: PlaneOperator, images: ElementalImages, weight: float | None = None) -> Image:
    """Return the plane that `reconstruct --method` would write."""
    return solve(operator, images, method, Settings(penalty_weight=weight)).plane


def _clipped(operator: PlaneOperator, images: ElementalImages) -> Image:
    """Return what a naive reading of eq. (2) gives: negative pixels clipped at zero, read noise not modelled."""
    floor = np.maximum(images.electrons, 0)
    return _solved("pmlem-osl", operator, replace(images, electrons=floor, read_variance_e2=0.0))


def _tv_denoised(operator: PlaneOperator, images: ElementalImages, weight: float) -> Image:
    """Return the back-projection, denoised by total variation (Chambolle 2004, as scikit-image has it)."""
    from skimage.restoration import denoise_tv_chambolle  # loading it takes a second

    plane = back_projection(operator, images)
    # Its usual tolerance stops it anywhere, and weights could not be compared
    return np.asarray(denoise_tv_chambolle(plane, weight=weight, eps=1e-5, max_num_iter=200), np.float32)


def _bm3d_denoised(operator: PlaneOperator, images: ElementalImages, weight: float) -> Image:
    """Return the back-projection, denoised by BM3D with a standard deviation of `weight` electrons."""
    import bm3d  # an extra

    return np.asarray(bm3d.bm3d(back_projection(operator, images), sigma_psd=weight), np.float32)


# The reconstruction that stands for the paper's, and the same with a weight that only the truth can tell.
OURS: Method = "pmlem"
BEST = "pmlem-best"

_PMLEM_WEIGHTS = tuple(np.geomspace(1.0, 3.2, 6).tolist())
_TV_WEIGHTS_E = tuple(np.geomspace(0.1, 1.6, 12).tolist())
_BM3D_WEIGHTS_E = tuple(np.geomspace(0.4, 1.2, 5).tolist())

# What stands first is drawn as the reference that the others have to beat.
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
    FigureMethod(BEST, "PMLEM, convergent, best weight", partial(_solved, OURS), _PMLEM_WEIGHTS),
)
