"""The search scores, refits and evaluates candidate effects, one after the other."""
