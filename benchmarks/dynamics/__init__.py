"""`ballfg-bench dynamics`."""
