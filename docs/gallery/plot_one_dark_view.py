"""
One dark view, and the plane reconstructed from 49
==================================================

A single view at SNR 0.16 shows next to nothing: about one electron reaches each pixel of the object, and the read noise
is three times as large. All 49 views together show the truck at 500 mm.
"""

# %%
# A small simulated set
# ---------------------
#
# The set is written as files, as a camera would do it, and then read in electrons.

from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

from faintfield import (
    DataFit,
    PlaneGrid,
    PlaneOperator,
    SyntheticOptions,
    channel_layouts,
    fronto_parallel_rt_ref_plane,
    load_channel,
    load_set,
    plane_from_ray,
    pmlem,
    simulate,
    smooth_start,
    universal_penalty_weight,
)

options = SyntheticOptions(rows=7, columns=7, size_px=(320, 240), seed=1)
with TemporaryDirectory() as folder, chdir(folder):
    simulate(Path("dark"), options=options)
    dark_set = load_set(Path("dark"))
    (layout,) = channel_layouts(dark_set)
    images = load_channel(dark_set, layout)

# %%
# The plane at 500 mm
# -------------------
#
# H needs the pose of each view, the lens, and the samples of the plane: one for each pixel of the reference view.

depth_mm = 500.0
lens = dark_set.settings.camera.lens
width_px, height_px = lens.size_px
pitch_mm = depth_mm / lens.fx_px
grid = PlaneGrid(
    shape=(height_px, width_px),
    pitch_mm=pitch_mm,
    origin_mm=(-lens.cx_px * pitch_mm, -lens.cy_px * pitch_mm),
)
poses_rt_cam_ref = np.array([view.rt_cam_ref for view in dark_set.settings.view])
rt_ref_plane = fronto_parallel_rt_ref_plane(depth_mm)
homographies = plane_from_ray(poses_rt_cam_ref, rt_ref_plane)
operator = PlaneOperator(homographies, lens.rays(), grid)

# %%
# Penalised maximum likelihood
# ----------------------------
#
# The solver yields one plane after another; it stops when the plane is certified to be within 1 % of the optimum.

start_e = smooth_start(operator, images)
weight = universal_penalty_weight(operator, images, start_e)
fit = DataFit(operator, images, level_e=1.0)
for iterate in pmlem(fit, start_e, penalty_weight=weight):
    if iterate.certificate.distance <= 0.01 or iterate.passes >= 60:
        break

# %%
# The result
# ----------

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
left.imshow(images.electrons[dark_set.reference_view], cmap="gray")
left.set_title("one of 49 views")
right.imshow(iterate.plane, cmap="gray", vmin=0.0)
right.set_title(f"plane at {depth_mm:g} mm, from all of them")
for axes in (left, right):
    axes.set_axis_off()
plt.show()
