"""Designs the most informative shots: predicts flights, computes their information, and chooses among them."""
