"""
Planes alone, together, and with occlusion
==========================================

A plane that is reconstructed alone contains the blur of the objects at other depths. Planes that are reconstructed
together share the light among them. With occlusion, nearer objects also hide farther ones.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import faintfield

folder = TemporaryDirectory()
dark = Path(folder.name, "dark")
faintfield.simulate(dark, options=faintfield.SyntheticOptions(size_px=(240, 180), snr=1.0))
light_field = faintfield.open(dark)

# %%
# The farther plane, the airplane at 700 mm, contains the blur of the truck if it is reconstructed alone.

titles = {"pmlem": "each alone", "joint": "together", "occlusion": "together, with occlusion"}
figure, axes = plt.subplots(2, 3, figsize=(13, 6.6), layout="constrained")
for column, (method, title) in zip(axes.T, titles.items(), strict=True):
    near, far = light_field.planes([500.0, 700.0], method=method, prior="tv")
    near.plot(column[0])
    far.plot(column[1])
    column[0].set_title(f"{title}: 500 mm")
    column[1].set_title("700 mm")
for axis in axes.flat:
    axis.set_axis_off()
plt.show()
