"""The failures of reconstruction; catch `ReconstructionError` to catch them all.

ReconstructionError
├── GeometryMismatch
├── NotConverged
└── NothingInFocus
"""


class ReconstructionError(Exception):
    """The requested plane cannot be reconstructed from the given views.

    All failures of reconstruction are of this class. Each message says what is wrong, the value and its limit, and
    after a semicolon what to do.

    Examples
    --------
    A plane behind the cameras:

    >>> import numpy as np
    >>> from faintfield import Lens, PlaneGrid, PlaneOperator, ReconstructionError
    >>> from faintfield import fronto_parallel_rt_ref_plane, plane_from_ray
    >>> lens = Lens((32, 24), fx_px=40.0, fy_px=40.0, cx_px=15.5, cy_px=11.5)
    >>> grid = PlaneGrid.covering(-160.0, -120.0, 160.0, 120.0, pitch_mm=10.0)
    >>> homographies = plane_from_ray(np.zeros((9, 6)), fronto_parallel_rt_ref_plane(depth_mm=-400.0))
    >>> try:
    ...     PlaneOperator(homographies, lens.rays(), grid)
    ... except ReconstructionError as failure:
    ...     print(failure)  # doctest: +NORMALIZE_WHITESPACE
    no pixel of any of the 9 views sees the plane of 32 x 24 samples; check its depth, the poses and their signs, and
    that not all pixels are masked (saturated, hot)
    """


class GeometryMismatch(ReconstructionError):
    """Poses, lens, images and plane do not fit together (the plane is behind the camera, for example).

    Check that the depth is positive and in mm, the signs of the poses, and the set.

    A message that names a range: `--depth-range-mm` lies where the views share nothing, or is too wide to be compared
    in 128 depths. Give the range of the scene; its near end matters most.
    """


class NotConverged(ReconstructionError):
    """An iteration left the range in which it is defined.

    The penalty weight is too large for these views: give a smaller `--penalty-weight`, or none.
    """


class NothingInFocus(ReconstructionError):
    """The views agree at no depth on anything that stands out of the noise.

    Give a range by `--sweep-mm`, or by `--depth-range-mm` for a surface; use more light; check the poses.

    A message that names shuffled views: the views agree no better than in random places (docs/explanation/depth.md),
    because of noise, copies, different scenes, or a wrong order. Check order and places of the pictures; use more
    light; or make planes at depths given by `--depth`.

    A message that names an option of `import grid`: rows or columns run the other way, or are exchanged. Import again
    with that option.
    """
