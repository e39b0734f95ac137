"""Total variation by pyproximal
=============================

pylops takes `faintfield.linear_operator` as it is, with the shapes of plane and images. Here pyproximal's primal-dual
iteration minimises ‖H f − g‖²/2v + β TV(f) for f ≥ 0, where v is the mean variance of a pixel. The example needs the
packages `pylops` and `pyproximal`.
"""

import numpy as np
import pylops
import pyproximal
from dark_scene import dark_scene, show
from pylops.utils import dottest
from pyproximal.optimization.primaldual import PrimalDual

from faintfield import back_projection, linear_operator, smooth_start, universal_penalty_weight

operator, dark, truth_e = dark_scene()
H = pylops.LinearOperator(linear_operator(operator))
print(H, "from a plane", H.dims, "to images", H.dimsd, "dot test:", dottest(H))

# %%
# Data and penalty are two blocks of one operator. The gradient is scaled to the norm of H: ‖H‖² is at most the largest
# number of Hᵀ H 1, and ‖∇‖² at most 8.

start_e = smooth_start(operator, dark)
weight = universal_penalty_weight(operator, dark, start_e)
variance_e2 = 3.5**2 + start_e.mean()
scale = np.sqrt(operator.coverage().max() / 8)
blocks = pylops.VStack([H, scale * pylops.Gradient(H.dims, edge=False, kind="forward", dtype=H.dtype)])
data = pyproximal.L2(b=dark.electrons.ravel(), sigma=1 / variance_e2)
penalty = pyproximal.L21(ndim=2, sigma=weight / scale)

# %%
# Step lengths of a product of 1/‖blocks‖² let the iteration converge; a short one of the plane makes it faster here.

step = 1 / (4 * scale)
plane_e = PrimalDual(
    pyproximal.Box(lower=0.0),
    pyproximal.VStack([data, penalty], nn=[H.shape[0], 2 * H.shape[1]]),
    blocks,
    start_e.ravel().copy(),
    tau=0.3 * step,
    mu=step / 0.3,
    niter=60,
)
show(truth_e, mean=back_projection(operator, dark), pyproximal=plane_e.reshape(H.dims))
