"""Prediction of a capture before it is made."""
