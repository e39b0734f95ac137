"""The capture: the loop over frames, its prompts and checks."""
