"""Lights that the rig switches: an output of the stage's controller, a command, the simulated lab's."""
