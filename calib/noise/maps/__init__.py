"""Maps of what differs from pixel to pixel."""
