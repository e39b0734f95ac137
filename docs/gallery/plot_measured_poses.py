"""
Measured and nominal poses
==========================

A gantry misses its nodes, the positions of the grid. Here positions are off by about 0.3 mm and rotations by about
3.5 mrad, which shifts the views by one or two pixels. With the commanded poses the plane is blurred. With the true
poses it is sharp.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

import faintfield

folder = TemporaryDirectory()
planes = {}
for poses in ("nominal", "true"):
    path = Path(folder.name, poses)
    faintfield.simulate(path, options=faintfield.SyntheticOptions(size_px=(320, 240), snr=0.5, poses=poses))
    light_field = faintfield.open(path)
    planes[poses] = light_field.plane(500.0)

# %%
# A rotation of 3.5 mrad shifts a view by this many pixels:

print(f"{3.5e-3 * light_field.lens.fx_px:.1f} px")

# %%
# On a real rig, `faintfield geometry` measures the poses with boards to some hundredths of a pixel, and `faintfield
# align` finds them by the views themselves.

figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
white = float(np.percentile(planes["true"].image, 99.5))
for axis, (poses, title) in zip(
    axes, {"nominal": "poses as commanded", "true": "poses as they were"}.items(), strict=True
):
    planes[poses].plot(axis, white=white)
    axis.set(title=title, xlim=(-170, 50), ylim=(105, -15))
plt.show()
