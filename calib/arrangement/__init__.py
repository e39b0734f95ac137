"""What the pictures of a grid of views say of their arrangement."""
