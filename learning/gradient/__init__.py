"""The gradient through a converged estimate."""
