"""From a set to its planes: channels, solving, sweeps, depth maps, accuracy."""
