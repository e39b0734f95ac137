"""Set-up of tests of reconstructions."""

import pytest


@pytest.fixture(autouse=True)
def _empty_pages(undrawn: None) -> None:
    """Leave the drawings of all pages empty."""
