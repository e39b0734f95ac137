"""Misfit of the model to the frames: scatter, goodness of fit, drift, contradictions."""
