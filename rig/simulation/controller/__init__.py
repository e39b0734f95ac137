"""Simulated stage controllers: firmware, motors and wires, with a clock of their own and faults to order."""
