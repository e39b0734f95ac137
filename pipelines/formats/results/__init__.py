"""Results: noise, geometry, planes and reconstructions, each with its record type."""
