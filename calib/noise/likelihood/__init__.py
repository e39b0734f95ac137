"""The likelihood of series of frames, with the response and the rounding of the sensor, and its maximum."""
