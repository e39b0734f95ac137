"""The failures of reconstruction; catch `ReconstructionError` to catch them all.

ReconstructionError
├── GeometryMismatch
├── NotConverged
└── NothingInFocus
"""


class ReconstructionError(Exception):
    """The requested plane cannot be reconstructed from the given views."""


class GeometryMismatch(ReconstructionError):
    """Poses, lens, images and plane do not fit together (the plane is behind the camera, for example)."""


class NotConverged(ReconstructionError):
    """An iteration left the range in which it is defined."""


class NothingInFocus(ReconstructionError):
    """The views agree at no depth on anything that stands out of the noise."""
