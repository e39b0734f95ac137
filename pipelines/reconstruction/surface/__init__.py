"""A surface with its picture: request, reconstruction, files, film."""
