"""Quantities by EMVA 1288."""
