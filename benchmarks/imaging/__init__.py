"""Planes, surfaces and predictions against the truth and against peers."""
