"""Simulated stage controllers: firmware, motors and wire, with a clock of their own and faults on demand."""
