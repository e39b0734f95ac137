"""The driver for Marlin."""
