"""Simulations of the lab, the camera and the stage, for use without hardware."""
