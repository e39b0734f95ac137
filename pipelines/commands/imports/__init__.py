"""`faintfield import`: other people's files become a set."""
