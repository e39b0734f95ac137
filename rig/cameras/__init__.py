"""Cameras: one protocol, and a driver for each way of reaching one."""
