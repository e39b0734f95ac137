"""
Wrong poses
===========

If the stated poses are not those of the camera, the views contradict one another at every depth. Almost no depth
is sure. `faintfield align` finds the poses from the views.
"""

from tempfile import TemporaryDirectory

import numpy as np
from light_field_scene import SIZE_PX, Layer, light_field, nodes_mm, show
from skimage.data import brick

scene = Layer(brick() / 255, 700.0)
stated_mm = nodes_mm() + np.random.default_rng(4).normal(0.0, 6.0, (49, 2))
stated_mm[24] = 0.0

# %%
# First with the true poses, then with poses that are wrong by 6 mm, about a pixel.

for poses_mm in (nodes_mm(), stated_mm):
    with TemporaryDirectory() as folder:
        surface = light_field(scene.seen_from, poses_mm=poses_mm).surface(folder, (350.0, 1000.0))
        show(surface, np.full(SIZE_PX[::-1], 700.0))
