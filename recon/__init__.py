"""Mathematics only: the operator, solvers, penalties and metrics. No files, no cameras, no printing."""
