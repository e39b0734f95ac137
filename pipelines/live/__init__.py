"""Run a guided capture and show it, in the terminal and on a local web page."""
