"""What a capture shows while it runs, in the terminal and on a local page."""
