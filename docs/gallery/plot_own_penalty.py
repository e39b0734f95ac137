"""
A penalty of your own
=====================

A penalty is any object with two methods: `value` returns R(f), and `prox` finds the plane of least R(f) plus squared
distance to another. The weight is chosen by cross-validation, as that of total variation is.
"""

import matplotlib.pyplot as plt
import numpy as np
from dark_scene import dark_light_field

light_field, truth_e = dark_light_field()

# %%
# The sparsity of a plane, R(f) = Σ f for f ≥ 0, draws each sample to zero by the same amount. This suits stars or beads
# before black. Tikhonov's penalty R(f) = ½ Σ f² draws bright samples more.


class Sparsity:
    """R(f) = Σ f for f ≥ 0."""

    def value(self, plane):
        """Return R(f)."""
        return float(plane.sum())

    def prox(self, point, metric, weight):
        """Return the x ≥ 0 of least ½ Σ metric (x − point)² + weight R(x)."""
        return np.maximum(point - weight / metric, 0)


class Tikhonov:
    """R(f) = ½ Σ f²."""

    def value(self, plane):
        """Return R(f)."""
        return 0.5 * float(np.vdot(plane, plane))

    def prox(self, point, metric, weight):
        """Return the x ≥ 0 of least ½ Σ metric (x − point)² + weight R(x)."""
        return np.maximum(metric * point / (metric + weight), 0)


# %%
# The scene is a field of small beads. The penalty that describes it best has the smallest error.

penalties = {"total variation": "tv", "Tikhonov": Tikhonov(), "sparsity": Sparsity()}
figure, axes = plt.subplots(1, 4, figsize=(14, 3.8), layout="constrained")
axes[0].imshow(truth_e, cmap="gray", vmin=0, vmax=truth_e.max())
axes[0].set_title("truth")
for axis, (name, penalty) in zip(axes[1:], penalties.items(), strict=True):
    plane = light_field.plane(400.0, prior="tv" if isinstance(penalty, str) else None, penalty=penalty)
    error_e = np.sqrt(np.mean((plane.image - truth_e) ** 2))
    axis.imshow(plane.image, cmap="gray", vmin=0, vmax=truth_e.max())
    axis.set_title(f"{name}, β = {plane.records[0].penalty_weight:.2g}\nrms error {error_e:.2f} e⁻")
for axis in axes:
    axis.set_axis_off()
plt.show()
