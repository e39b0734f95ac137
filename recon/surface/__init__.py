"""A surface: one picture with the depth of each of its samples, from all views together."""
