"""
Even walls
==========

Where a wall has no detail, the views agree at every depth. The depth there is continued from its surroundings, and is
not *sure* (confidence below 0.9). The picture is still right, because every depth predicts the same light.
"""

from tempfile import TemporaryDirectory

import numpy as np
from light_field_scene import SIZE_PX, Layer, light_field, show
from skimage.data import brick

wall = np.full((512, 512), 0.6)
wall[:, :200] = brick()[:, :200] / 255  # the left part has detail
scene = Layer(wall, 700.0)

with TemporaryDirectory() as folder:
    surface = light_field(scene.seen_from).surface(folder, (350.0, 1000.0))
    show(surface, np.full(SIZE_PX[::-1], 700.0))
