"""How far away things are: how well the views agree, focus, and the planes of best focus."""
