"""Benchmarks compare estimators and measure the cost of an estimate; `ballfg-bench` runs them."""
