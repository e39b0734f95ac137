"""Longest wait of tests for a process, a thread or a page that never fails to come, unless it hangs."""

# About ten times as long as the slowest of them takes on a machine that does nothing else, so that a busy machine does
# not meet it. Less than `timeout` in pyproject.toml, so that the message says what did not come.
HANG_S = 600.0
