"""Calculations of the commands, from input to pages: each command is a function here and its options in `commands`."""
