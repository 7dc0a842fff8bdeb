"""Benchmarks: the estimators against each other, and what an estimate costs; `ballfg-bench` runs them."""
