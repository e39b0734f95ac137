"""The commands: load, call, save, show. The only package that parses arguments, prints or draws."""
