"""
Sure and unsure depths
======================

Each depth of a surface has a *confidence*: the probability that it is right within 2 %. Here the true depths are known,
so that the confidence can be checked.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

import faintfield

folder = TemporaryDirectory()
dark = Path(folder.name, "dark")
options = faintfield.SyntheticOptions(size_px=(240, 180), snr=0.5, objects="surfaces", seed=2)
faintfield.simulate(dark, options=options)
surface = faintfield.open(dark).surface(Path(folder.name, "surface"), (450.0, 1100.0))
true_depth_mm = faintfield.read_frame(dark / "truth" / "true_depth_mm.tiff").pixels_dn

error = np.abs(surface.depth / true_depth_mm - 1)
known = np.isfinite(error)
sure = surface.sure & known
print(f"sure: {sure.mean():.0%} of the depths; {np.mean(error[sure] < 0.02):.1%} of these are right within 2 %")

# %%
# Wrong depths lie where the scene has little detail. Few of them are *sure*, with a confidence of at least 0.9.

figure, axes = plt.subplots(1, 3, figsize=(14, 3.6), layout="constrained")
confidence = axes[0].imshow(surface.confidence, vmin=0, vmax=1)
axes[0].set(title="confidence", xticks=[], yticks=[])
figure.colorbar(confidence, ax=axes[0], fraction=0.036, pad=0.02)
axes[1].imshow(np.where(known, error > 0.02, np.nan), cmap="gray_r")
axes[1].set(title="black: wrong by more than 2 %", xticks=[], yticks=[])

edges = np.linspace(0, 1, 11)
groups = np.digitize(surface.confidence[known], edges[1:-1])
right = [np.mean(error[known][groups == number] < 0.02) for number in range(10) if np.any(groups == number)]
stated = [surface.confidence[known][groups == number].mean() for number in range(10) if np.any(groups == number)]
axes[2].plot([0, 1], [0, 1], color="0.6", linestyle="--")
axes[2].plot(stated, right, "o-")
axes[2].set(xlabel="stated confidence", ylabel="share that is right", title="above the line: more right than stated")
plt.show()
