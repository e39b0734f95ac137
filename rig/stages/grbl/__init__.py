"""The driver for GRBL 1.1 and grblHAL."""
