"""Poses of the camera at every node and its lens, with their uncertainty."""

from faintfield.calib.geometry.acceptance import rms_over_views, transfer_sigma_at
from faintfield.calib.geometry.calibrate import GeometrySettings, calibrate_geometry
from faintfield.calib.geometry.observations import BoardObservation, Node, Target
from faintfield.calib.geometry.rig_geometry import BoardPose, RigGeometry

__all__ = [
    "BoardObservation",
    "BoardPose",
    "GeometrySettings",
    "Node",
    "RigGeometry",
    "Target",
    "calibrate_geometry",
    "rms_over_views",
    "transfer_sigma_at",
]
