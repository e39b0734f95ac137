"""Cameras: one protocol, and a driver for each way to connect one."""
