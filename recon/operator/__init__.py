"""The operator H, which maps the planes of a scene to the pixels of each view, and its exact adjoint."""
