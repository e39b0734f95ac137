"""
A mirror
========

All views agree on the image behind a plane mirror. The depth found is that of the mirrored object, as sure as any
other: nothing in a light field shows that there is a mirror.
"""

from tempfile import TemporaryDirectory

import numpy as np
from light_field_scene import SIZE_PX, Image, Layer, Place, light_field, show, window
from skimage.data import brick, gravel

wall, mirrored = Layer(brick() / 255, 500.0), Layer(gravel()[:, ::-1] / 255, 850.0)


def view(camera_mm: Place) -> Image:
    """Return the wall, and in a mirror on it an object 350 mm in front of it."""
    return np.where(window(camera_mm, wall.depth_mm), mirrored.seen_from(camera_mm), wall.seen_from(camera_mm))


# %%
# The wall with the mirror is at 500 mm, which is drawn as the true depth. What the mirror shows is found at 850 mm.

with TemporaryDirectory() as folder:
    surface = light_field(view).surface(folder, (350.0, 1000.0))
    show(surface, np.full(SIZE_PX[::-1], wall.depth_mm))
    in_mirror_mm = surface.depth[window((0.0, 0.0), wall.depth_mm) & surface.sure]
    if in_mirror_mm.size:
        print(f"median of the sure depths in the mirror: {np.median(in_mirror_mm):.0f} mm")
