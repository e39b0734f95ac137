"""Sets whose truth is known: simulated light on a simulated sensor."""
