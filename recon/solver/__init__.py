"""Penalised maximum likelihood: problems, penalties, iterations, weights, uncertainty."""
