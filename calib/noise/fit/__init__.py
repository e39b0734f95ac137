"""The fit of the series, with the scatter between them."""
