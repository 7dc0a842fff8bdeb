"""Find what a model lacks: residuals, candidate effects, tests, the loop and its report."""
