"""
One sharp picture, and its depth
================================

A scene that is not flat has no single depth at which it is sharp. A *surface* is one picture that is sharp everywhere,
together with the depth of each of its samples.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import faintfield

folder = TemporaryDirectory()
dark = Path(folder.name, "dark")
options = faintfield.SyntheticOptions(size_px=(320, 240), snr=2.0, objects="surfaces")
faintfield.simulate(dark, options=options)
light_field = faintfield.open(dark)
surface = light_field.surface(Path(folder.name, "surface"), (450.0, 1100.0))
print(surface)

# %%
# A slanted wall, a rising floor, a ball, a tilted page and a thin rod. The depth is drawn where it is sure.

# sphinx_gallery_thumbnail_number = 2

light_field.plot()
surface.plot()
plt.show()
