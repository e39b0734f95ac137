"""
Repeated patterns
=================

A pattern that repeats within the parallax of the views matches itself at several depths. No comparison of the views can
show which of them is true.
"""

from light_field_scene import FOCAL_PX, STEP_MM, Layer, light_field
from numpy import indices

import faintfield

# %%
# A wall of squares is at 700 mm. A square is 4 px wide in a view, so the pattern repeats after 8 px.

true_depth_mm = 700.0
squares = (indices((512, 512)) // 16).sum(axis=0) % 2
views = light_field(Layer(0.2 + 0.6 * squares, true_depth_mm).seen_from)

# %%
# The search for depths is refused: the views agree no better than in shuffled places.

try:
    views.find_depths((300.0, 1000.0))
except faintfield.ReconstructionError as failure:
    print(failure)

# %%
# At the true depth a point moves by 6.9 px from view to view. At the depth where it moves by 8 px more, the plane is as
# sharp. Only other knowledge of the depth helps.

moved_px = FOCAL_PX * STEP_MM / true_depth_mm
wrong_depth_mm = round(FOCAL_PX * STEP_MM / (moved_px + 8.0))
views.planes([wrong_depth_mm, 500.0, true_depth_mm], prior="tv").plot()
