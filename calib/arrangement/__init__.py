"""Arrangement of a grid of views, as its pictures show it."""
