"""Translates a torch function to the source of machine code."""
