"""The commands, one file each: parse the arguments, call what does the work, print what came of it."""
