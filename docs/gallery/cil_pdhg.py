"""Total variation by CIL
======================

CIL, the Core Imaging Library, is installed by conda only. So this page shows the code without its result: it was
written from CIL's sources and has not been run. A class with `direct` and `adjoint` makes H an operator of CIL; the
views are the channels of its images. PDHG then minimises ‖H f − g‖²/2v + β TV(f) for f ≥ 0.
"""

import numpy as np
from cil.framework import ImageGeometry
from cil.optimisation.algorithms import PDHG
from cil.optimisation.functions import BlockFunction, IndicatorBox, L2NormSquared, MixedL21Norm
from cil.optimisation.operators import BlockOperator, GradientOperator, LinearOperator
from dark_scene import dark_scene, show

from faintfield import PlaneOperator, back_projection, smooth_start, universal_penalty_weight


class ViewsOperator(LinearOperator):
    """H of a plane as an operator of CIL."""

    def __init__(self, operator: PlaneOperator) -> None:
        self.operator = operator
        views, image_rows, image_columns = operator.images_shape
        rows, columns = operator.grid.shape
        super().__init__(
            domain_geometry=ImageGeometry(columns, rows),
            range_geometry=ImageGeometry(image_columns, image_rows, channels=views),
        )

    def direct(self, x, out=None):
        """Return H f."""
        out = self.range_geometry().allocate(None) if out is None else out
        out.fill(self.operator.forward(x.as_array()).astype(np.float32))
        return out

    def adjoint(self, x, out=None):
        """Return Hᵀ g."""
        out = self.domain_geometry().allocate(None) if out is None else out
        out.fill(self.operator.adjoint(x.as_array()).astype(np.float32))
        return out


operator, dark, truth_e = dark_scene()
H = ViewsOperator(operator)
print("dot test:", LinearOperator.dot_test(H))

# %%
# Data and penalty are two blocks of one operator, scaled to the same norm.

start_e = smooth_start(operator, dark)
weight = universal_penalty_weight(operator, dark, start_e)
variance_e2 = 3.5**2 + float(start_e.mean())
scale = float(np.sqrt(operator.coverage().max() / 8))
images = H.range_geometry().allocate(None)
images.fill(dark.electrons.astype(np.float32))
pdhg = PDHG(
    f=BlockFunction(1 / (2 * variance_e2) * L2NormSquared(b=images), weight / scale * MixedL21Norm()),
    g=IndicatorBox(lower=0),
    operator=BlockOperator(H, scale * GradientOperator(H.domain_geometry())),
)
pdhg.run(100)
show(truth_e, mean=back_projection(operator, dark), CIL=pdhg.solution.as_array())
