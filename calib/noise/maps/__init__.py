"""What differs from pixel to pixel."""
