"""Calibration of the camera: noise, lens, poses, and the homographies of a plane."""
