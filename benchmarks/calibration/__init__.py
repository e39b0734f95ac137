"""Accuracy, coverage and cost of the calibration of noise and geometry."""
