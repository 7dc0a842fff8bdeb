"""Turns torch models into machine code: traces, differentiates, writes source, compiles it by numba and caches it."""
