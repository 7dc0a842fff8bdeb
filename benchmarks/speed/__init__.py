"""`ballfg-bench speed`."""
