"""
A light field from pictures
===========================

Pictures in a folder, named by their row and column, become a light field by `faintfield import grid`. Their poses are
not known in mm, so that depths are disparities: the pixels that a point moves from one picture to the next.
"""

import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import matplotlib.pyplot as plt
import numpy as np

import faintfield

folder = TemporaryDirectory()
pictures, bright, dark = (Path(folder.name, name) for name in ("pictures", "bright", "dark"))
pictures.mkdir()

# %%
# Here rendered views stand in for photographs, as JPEGs with the tone curve of a camera.

options = faintfield.SyntheticOptions(
    size_px=(240, 180), lens="ideal", position_error_mm=0.0, rotation_error_mrad=0.0, objects="surfaces", pitch_mm=30.0
)
faintfield.simulate(Path(folder.name, "scene"), options=options)
scene = faintfield.open(Path(folder.name, "scene", "noise_free"))
white_e = np.percentile(scene.images_e, 99.9)
for (row, column), image_e in zip(scene.nodes, scene.images_e, strict=True):
    tones = 255 * np.clip(image_e / white_e, 0, 1) ** (1 / 2.2)
    cv2.imwrite(str(pictures / f"view_r{row}_c{column}.jpg"), np.round(tones).astype(np.uint8))

# %%
# The commands are those of a terminal: read the folder, and make dark pictures of it, at SNR 1.

subprocess.run(["faintfield", "import", "grid", pictures, bright], check=True, capture_output=True)
subprocess.run(["faintfield", "darken", bright, dark, "--snr", "1"], check=True, capture_output=True)
light_field = faintfield.open(dark)
print(light_field)

# %%
# One picture that is sharp everywhere, and the disparity of its points.

surface = light_field.surface(Path(folder.name, "surface"))
# sphinx_gallery_thumbnail_number = 2

light_field.plot()
surface.plot()
plt.show()
