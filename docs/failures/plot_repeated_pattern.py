"""
Repeated patterns
=================

A pattern that repeats within the parallax of the views fits itself at several depths. Its depth is that of its
surroundings, or a wrong one. Little of it is called sure.
"""

from tempfile import TemporaryDirectory

import numpy as np
from light_field_scene import SIZE_PX, Layer, light_field, show
from skimage.data import brick

import faintfield

pattern = 0.2 + 0.6 * ((np.indices((512, 512)) // 16).sum(axis=0) % 2)  # squares of 4 px in the reference view
wall = np.where(np.arange(512) < 352, brick() / 255, pattern)

with TemporaryDirectory() as folder:
    surface = light_field(Layer(wall, 700.0).seen_from).surface(folder, (350.0, 1000.0))
    show(surface, np.full(SIZE_PX[::-1], 700.0))

# %%
# A wall of nothing but squares is refused: the views agree as well in random places as in their own.

with TemporaryDirectory() as folder:
    try:
        light_field(Layer(pattern, 700.0).seen_from).surface(folder, (350.0, 1000.0))
    except faintfield.ReconstructionError as failure:
        print(failure)
