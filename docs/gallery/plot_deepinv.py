"""Plug-and-play by deepinv
========================

deepinv takes H as two functions of tensors of the shape (batch, channel, ...); here the views are the channels of the
images. A proximal gradient iteration uses a denoiser in place of a penalty. Here it is total generalised variation,
which keeps slopes as well as edges and needs no training. A network of `deepinv.models` can replace it, once its
weights are loaded. The example needs the packages `torch` and `deepinv`.
"""

import torch
from dark_scene import dark_scene, show
from deepinv.models import TGVDenoiser
from deepinv.optim import L2, PGD, PnP
from deepinv.physics import LinearPhysics

from faintfield import back_projection

operator, dark, truth_e = dark_scene()


def forward(planes: torch.Tensor) -> torch.Tensor:
    """Return the images (1, view, row, column) of a plane (1, 1, row, column)."""
    return torch.from_numpy(operator.forward(planes.numpy()[0, 0]))[None]


def adjoint(images: torch.Tensor) -> torch.Tensor:
    """Return the plane of images."""
    return torch.from_numpy(operator.adjoint(images.numpy()[0]))[None, None]


physics = LinearPhysics(A=forward, A_adjoint=adjoint)
images = torch.from_numpy(dark.electrons)[None]
mean_e = back_projection(operator, dark)
start = torch.from_numpy(mean_e)[None, None]
print(f"dot test: {float(physics.adjointness_test(start)):.1e}")

# %%
# A step of 1/‖H‖² at most lets the iteration converge; the largest number of Hᵀ H 1 bounds ‖H‖². The strength of the
# denoiser is chosen by eye.

denoiser = TGVDenoiser(n_it_max=20)
denoiser.tau = 0.03  # the step of its iteration, for light of some electrons
solve = PGD(
    data_fidelity=L2(),
    prior=PnP(denoiser),
    stepsize=1 / float(operator.coverage().max()),
    sigma_denoiser=4.0,
    max_iter=15,
)
with torch.no_grad():
    plane = solve(images, physics, init=start)

show(truth_e, mean=mean_e, deepinv=plane.numpy()[0, 0])
