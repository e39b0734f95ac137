"""Everything that touches the world: stage, camera, session on disk, and the simulated world."""
