"""
A colour camera without demosaicing
===================================

Behind a Bayer mosaic each pixel sees one colour. Demosaicing mixes neighbouring pixels, and with them their noise. H
takes each pixel as it is: the pixels of 49 shifted views fill the samples of each colour.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import faintfield

folder = TemporaryDirectory()
dark = Path(folder.name, "dark")
faintfield.simulate(dark, options=faintfield.SyntheticOptions(size_px=(240, 180), snr=0.5, colour="bayer"))
light_field = faintfield.open(dark)
print(light_field)
truck = light_field.plane(500.0)

# %%
# One view as recorded, and the plane in colour.

figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
light_field.plot(axes=axes[0])
axes[0].set_title("one of 49 views, pixels as recorded")
truck.plot(axes[1])
plt.show()
