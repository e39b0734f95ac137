"""What a capture will show, before it is made."""
