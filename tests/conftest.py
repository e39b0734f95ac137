"""Hypothesis draws the same examples in every run; `--hypothesis-profile=search` looks for new ones."""

import pytest
from hypothesis import settings

# So that failures in helpers show values, too
pytest.register_assert_rewrite(
    *(f"tests.{name}" for name in ("rig", "calib", "recon", "pipelines", "faults", "end_to_end"))
)

settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=50)
settings.register_profile("search", deadline=None, max_examples=500)
settings.load_profile("repeatable")
