"""The simulated world: what the rig would meet, without the rig."""
