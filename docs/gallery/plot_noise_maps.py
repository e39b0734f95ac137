"""
Noise maps of each pixel
========================

Pixels of one sensor differ. From dark frames, faintfield measures the offset and the read noise of each pixel, and
finds hot and noisy ones. The reconstruction uses these maps, and leaves unusable pixels out.
"""

import matplotlib.pyplot as plt
import numpy as np

from faintfield import Conditions, calibrate_noise, measure_series

# %%
# A simulated sensor: columns with offsets of their own, dark currents that differ by 30 %, pixels with more read
# noise, and hot pixels.

rng = np.random.default_rng(3)
shape = (128, 128)
offset_dn = 100.0 + rng.normal(0.0, 3.0, shape[1]) + rng.normal(0.0, 1.0, shape)
dark_e_per_s = 0.5 * rng.lognormal(0.0, 0.3, shape)
dark_e_per_s[rng.random(shape) < 0.002] = 200.0
read_noise_e = np.where(rng.random(shape) < 0.02, 8.0, 3.0)


def dark_series(exposure_s: float, frames: int = 40):
    """Return the statistics of dark frames of one exposure."""
    electrons = rng.poisson(dark_e_per_s * exposure_s, (frames, *shape)) + rng.normal(0, read_noise_e, (frames, *shape))
    pixels_dn = np.round(offset_dn + 2.0 * electrons).astype(np.uint16)
    named = ((f"dark {number}", frame) for number, frame in enumerate(pixels_dn))
    return measure_series(named, Conditions("dark", exposure_s))


calibration = calibrate_noise([dark_series(exposure_s) for exposure_s in (0.1, 1.0, 10.0)])
maps = calibration.maps
print(f"{maps.unusable.sum()} unusable pixels; {np.sum(dark_e_per_s == 200.0)} are hot in truth")

# %%
# Each map is the best estimate of each pixel: where the frames tell little, it is close to the mean of all pixels.

pictures = {
    "offset, DN": maps.offset_dn,
    "dark current, e/s": maps.dark_current_e_per_s,
    "read noise, e": maps.read_noise_e,
    "unusable": maps.unusable,
}
figure, axes = plt.subplots(1, 4, figsize=(15, 3.6), layout="constrained")
for axis, (title, picture) in zip(axes, pictures.items(), strict=True):
    low, high = np.percentile(picture[~maps.unusable], (0.5, 99.5)) if picture.dtype != bool else (0, 1)
    image = axis.imshow(picture, vmin=low, vmax=high)
    axis.set(title=title, xticks=[], yticks=[])
    figure.colorbar(image, ax=axis, fraction=0.046, pad=0.02)
plt.show()
