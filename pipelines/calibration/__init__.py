"""From frames to what is known of the camera: its noise, its lens and poses."""
