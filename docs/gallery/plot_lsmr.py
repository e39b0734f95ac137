"""Least squares by scipy
======================

`faintfield.linear_operator` makes a linear operator of scipy from H. Here `scipy.sparse.linalg.lsmr` minimises
‖H f − g‖² + λ² ‖f‖², and `faintfield.pmlem` the likelihood with total variation.
"""

import numpy as np
from dark_scene import dark_scene, show
from scipy.sparse.linalg import lsmr

from faintfield import DataFit, back_projection, linear_operator, pmlem, smooth_start, universal_penalty_weight

operator, dark, truth_e = dark_scene()
H = linear_operator(operator)
print(H, "from a plane", H.dims, "to images", H.dimsd)

# %%
# The dot test: H and its transpose fit together if ⟨H x, y⟩ = ⟨x, Hᵀ y⟩.

rng = np.random.default_rng(2)
x, y = rng.normal(size=H.shape[1]), rng.normal(size=H.shape[0])
print(f"⟨H x, y⟩ = {y @ (H @ x):.9f}, ⟨x, Hᵀ y⟩ = {x @ (H.T @ y):.9f}")

# %%
# Damping draws samples towards zero, so the mean is subtracted first. λ² is the variance of the noise over that of the
# scene: the estimate is then the best linear one for a scene without structure.

start_e = smooth_start(operator, dark)
mean_e, noise_e2 = start_e.mean(), 3.5**2 + start_e.mean()
difference = dark.electrons.ravel() - H @ np.full(H.shape[1], mean_e)
solution, _, iterations, *_ = lsmr(H, difference, damp=np.sqrt(noise_e2 / start_e.var()))
damped_e = mean_e + solution.reshape(H.dims)
print(f"lsmr: {iterations} iterations")

# %%
# Least squares undoes the blur of the mean of the views, and amplifies the noise. The likelihood includes that light
# is positive and that its noise grows with it. Total variation smooths all but edges.

weight = universal_penalty_weight(operator, dark, start_e)
for iterate in pmlem(DataFit(operator, dark, level_e=1.0), start_e, penalty_weight=weight):
    if iterate.certificate.distance <= 0.01 or iterate.passes >= 100:
        break
print(f"pmlem: {iterate.passes} passes, at most {iterate.certificate.distance:.1%} from the optimum")

show(truth_e, mean=back_projection(operator, dark), lsmr=damped_e, pmlem=iterate.plane)
