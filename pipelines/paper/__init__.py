"""The paper's experiment: its figures, and the demo's rig and truth."""
