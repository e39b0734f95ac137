"""Everything that is read or written and has a format."""
