"""The planes of a set: settings and solutions, solvers, priors, tasks in one process or several."""
