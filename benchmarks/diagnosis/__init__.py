"""`ballfg-bench loop`."""
