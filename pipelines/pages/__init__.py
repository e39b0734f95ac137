"""HTML pages and the drawings in them."""
