"""Inputs: elemental sets, sessions, noise sets, board sets, and the truth of simulated ones."""
