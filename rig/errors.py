"""The failures of the rig, one tree: catch `RigError` to catch them all.

RigError
"""


class RigError(Exception):
    """Something in the world (stage, camera, session on disk) is not as it must be."""
