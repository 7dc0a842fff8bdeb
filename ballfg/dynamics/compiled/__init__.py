"""Machine code from torch models: traced, differentiated, written as source, compiled by numba, kept on disk."""
