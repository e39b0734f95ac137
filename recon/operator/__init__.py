"""H: what each detector pixel of each view sees of a scene, and the exact adjoint."""
