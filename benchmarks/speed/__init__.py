"""Speed and memory of passes, solvers, sessions and whole sets."""
