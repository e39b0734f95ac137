"""Hypothesis draws the same examples in every run; `--hypothesis-profile=search` looks for new ones."""

from hypothesis import settings

settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=50)
settings.register_profile("search", deadline=None, max_examples=500)
settings.load_profile("repeatable")
