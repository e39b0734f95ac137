"""Run a capture: the loop over frames, prompts, checks of frames and boards, settling and drift."""
