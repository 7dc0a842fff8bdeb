"""Translates the functions that numba compiles to C99: the same loops, for arrays whose sizes are known."""
