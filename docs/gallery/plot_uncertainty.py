"""
The standard deviation of each sample
=====================================

With `uncertainty=True` a plane has a standard deviation σ for each sample. It counts the noise and the contrast that
the penalty removed. Here the truth is known: about 90 % of the samples should lie within 1.64 σ of it.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

import faintfield

folder = TemporaryDirectory()
dark = Path(folder.name, "dark")
faintfield.simulate(dark, options=faintfield.SyntheticOptions(size_px=(320, 240), snr=0.5))
plane = faintfield.open(dark).plane(500.0, uncertainty=True)
texture = faintfield.read_frame(dark / "truth" / "plane_00500.0.tiff").pixels_dn
visible = faintfield.read_frame(dark / "truth" / "visible_00500.0.png").pixels_dn > 0

error_e = np.where(visible, plane.image - texture, np.nan)
inside = np.mean(np.abs(error_e[visible]) < 1.64 * plane.sigma[visible])
print(f"{inside:.0%} of the samples of the truck lie within 1.64 σ of the truth")

# %%
# σ is largest at edges, because their place is uncertain.

figure, axes = plt.subplots(1, 3, figsize=(14, 3.6), layout="constrained")
plane.plot(axes[0])
sigma = axes[1].imshow(plane.sigma)
figure.colorbar(sigma, ax=axes[1], label="σ, e⁻", fraction=0.036, pad=0.02)
limit = float(np.nanpercentile(np.abs(error_e), 99))
error = axes[2].imshow(error_e, cmap="RdBu", vmin=-limit, vmax=limit)
figure.colorbar(error, ax=axes[2], label="error, e⁻", fraction=0.036, pad=0.02)
for axis, title in zip(axes, ("plane at 500 mm", "standard deviation", "error, on the truck"), strict=True):
    axis.set_title(title)
    axis.set_axis_off()
plt.show()
