"""Depth of objects: agreement of the views, focus, and planes of best focus."""
