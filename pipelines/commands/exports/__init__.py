"""`faintfield export`: sets and results become files of other people's programs."""
