"""Better pictures than the penalty alone gives: candidates from patches, mixed by how they predict held-out views."""
