"""The front door in Python: light fields and results as objects with arrays, for notebooks and scripts."""
