"""A session on disk: the frozen plan, the frames, and the journal of everything that happened."""
