"""Computes the gradient through a converged estimate."""
