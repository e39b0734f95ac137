"""
A denoiser of your own as the prior
===================================

A prior is any function that takes a picture and the standard deviation of its noise, and returns it without noise.
Here it is the non-local means filter of scikit-image. Held-out views decide how much of it is used, and the data keep
the last word.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
from skimage.restoration import denoise_nl_means

import faintfield

folder = TemporaryDirectory()
dark = Path(folder.name, "dark")
faintfield.simulate(dark, options=faintfield.SyntheticOptions(size_px=(240, 180), snr=0.5))
light_field = faintfield.open(dark)
texture = faintfield.read_frame(dark / "truth" / "plane_00500.0.tiff").pixels_dn
visible = faintfield.read_frame(dark / "truth" / "visible_00500.0.png").pixels_dn > 0


def nonlocal_means(picture, sigma):
    """Return a picture (row, column) without its noise of standard deviation sigma (row, column)."""
    noise = float(sigma.mean())
    return denoise_nl_means(picture, patch_size=5, patch_distance=9, h=0.8 * noise, sigma=noise)


priors = {"total variation": "tv", "non-local means": nonlocal_means, "auto, the default": "auto"}
planes = {name: light_field.plane(500.0, prior=prior) for name, prior in priors.items()}

# %%
# The default mixes a filter of patches and a small network. Any other denoiser can take their place.

white = float(np.percentile(texture[visible], 99.5))
figure, axes = plt.subplots(1, 3, figsize=(14, 3.8), layout="constrained")
for axis, (name, plane) in zip(axes, planes.items(), strict=True):
    error_e = np.sqrt(np.mean((plane.image - texture)[visible] ** 2))
    plane.plot(axis, white=white)
    axis.set_title(f"{name}: rms error {error_e:.3f} e⁻")
    axis.set_axis_off()
plt.show()
