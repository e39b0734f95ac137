"""
One dark view, and the planes of all views
==========================================

At SNR 0.16, each pixel of the object gets about one electron of signal and 3.5 electrons of read noise. A single
view shows next to nothing. All 49 views together show a truck at 500 mm and an airplane at 700 mm.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import faintfield

folder = TemporaryDirectory()
dark = Path(folder.name, "dark")
faintfield.simulate(dark, options=faintfield.SyntheticOptions(size_px=(320, 240)))
light_field = faintfield.open(dark)
print(light_field)

# %%
# The mean of the views, each shifted to the plane (back-projection), is what most light-field cameras show. The
# planes by maximum likelihood use the noise of the sensor, and a prior for the detail.

mean = light_field.plane(500.0, method="backprojection")
truck, airplane = light_field.planes([500.0, 700.0], method="occlusion")

figure, axes = plt.subplots(2, 2, figsize=(10, 8), layout="constrained")
light_field.plot(axes=axes[0, 0])
mean.plot(axes[0, 1])
truck.plot(axes[1, 0])
airplane.plot(axes[1, 1])
axes[0, 0].set_title("one of 49 views")
axes[0, 1].set_title("mean of all views at 500 mm")
axes[1, 0].set_title("maximum likelihood, 500 mm")
axes[1, 1].set_title("maximum likelihood, 700 mm")
plt.show()
