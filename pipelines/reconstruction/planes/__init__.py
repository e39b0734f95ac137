"""Planes: solvers, priors, and the tasks of a sweep in one process or several."""
