"""
The penalty weight
==================

The weight β of the penalty decides how smooth a plane becomes. By default, the weight is chosen that predicts held-out
views best. Here the truth is known, so the choice can be compared with the best one.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

import faintfield

folder = TemporaryDirectory()
dark = Path(folder.name, "dark")
faintfield.simulate(dark, options=faintfield.SyntheticOptions(size_px=(320, 240), snr=0.5))
light_field = faintfield.open(dark)
texture = faintfield.read_frame(dark / "truth" / "plane_00500.0.tiff").pixels_dn
visible = faintfield.read_frame(dark / "truth" / "visible_00500.0.png").pixels_dn > 0


def error(plane: faintfield.Plane) -> float:
    """Return the root mean square error over the visible object."""
    return float(np.sqrt(np.mean((plane.image - texture)[visible] ** 2)))


# %%
# The chosen weight, and planes with weights from a tenth to ten times as large.

chosen = light_field.plane(500.0, prior="tv")
weight = chosen.records[0].penalty_weight
factors = np.geomspace(0.1, 10.0, 9)
planes = [light_field.plane(500.0, prior="tv", penalty_weight=factor * weight) for factor in factors]
errors = [error(plane) for plane in planes]
print(f"chosen: β = {weight:.3g}, error {error(chosen):.3g}; smallest error {min(errors):.3g}")

# %%
# Too small a weight leaves noise, too large a weight removes detail.

figure, axes = plt.subplots(1, 4, figsize=(14, 3.4), layout="constrained")
for axis, (title, plane) in zip(
    axes, {"β / 10": planes[0], "β, chosen": chosen, "10 β": planes[-1]}.items(), strict=False
):
    plane.plot(axis, white=float(np.percentile(texture[visible], 99.5)))
    axis.set_title(title)
    axis.set_axis_off()
axes[3].loglog(factors, errors, "o-")
axes[3].axvline(1.0, color="0.5", linestyle="--")
axes[3].set(xlabel="weight / chosen weight", ylabel="rms error")
plt.show()
