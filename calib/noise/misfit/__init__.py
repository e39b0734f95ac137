"""Where the frames deny the model: scatter, goodness of fit, drift, contradictions."""
