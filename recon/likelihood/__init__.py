"""Elemental images and the statistical models of their pixels."""
