"""The search: candidate effects are scored, refitted and evaluated, one after the other."""
