"""XY stages for which Micro-Manager has a device adapter."""
