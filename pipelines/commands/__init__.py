"""The commands, one file each: parse the arguments, call what does the work, print what came of it.

Help loads the module of a command, so what does the work is imported in functions. The annotations of a command are
looked up then, too, but not what a `type` statement stands for: its result is one where its type would load much.
"""
