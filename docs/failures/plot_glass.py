"""
Glass
=====

A pane shows two things in one place: what is behind it, and what it reflects. A surface has one depth for each
sample, that of the stronger detail.
"""

from tempfile import TemporaryDirectory

import numpy as np
from light_field_scene import Image, Layer, Place, light_field, show, window
from skimage.data import brick, grass, gravel

wall, room, reflection = Layer(brick() / 255, 500.0), Layer(gravel() / 255, 650.0), Layer(grass() / 255, 900.0)


def view(camera_mm: Place) -> Image:
    """Return the wall with a window: three quarters of the light of the room, and one quarter of the reflection."""
    behind = 0.75 * room.seen_from(camera_mm) + 0.25 * reflection.seen_from(camera_mm)
    return np.where(window(camera_mm, wall.depth_mm), behind, wall.seen_from(camera_mm))


# %%
# The depth of the room behind the window is drawn as the true one.

with TemporaryDirectory() as folder:
    surface = light_field(view).surface(folder, (350.0, 1000.0))
    show(surface, np.where(window((0.0, 0.0), wall.depth_mm), room.depth_mm, wall.depth_mm))
