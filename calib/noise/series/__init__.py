"""Frames reduced to the sufficient statistics of their series."""
