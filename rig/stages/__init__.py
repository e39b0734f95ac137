"""Stages: two axes that carry the camera, and the serial protocols that drive them."""
