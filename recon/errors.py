"""The failures of reconstruction, one tree: catch `ReconstructionError` to catch them all.

ReconstructionError
├── GeometryMismatch
├── NotConverged
└── NothingInFocus
"""


class ReconstructionError(Exception):
    """The plane asked for cannot be reconstructed from the views given."""


class GeometryMismatch(ReconstructionError):
    """Poses, lens, images and plane do not fit together (a plane behind the camera, say)."""


class NotConverged(ReconstructionError):
    """An iteration left the numbers it is defined on."""


class NothingInFocus(ReconstructionError):
    """At no depth do the views agree on anything that stands out of the noise."""
