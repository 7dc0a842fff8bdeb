"""`ballfg-bench cameras`."""
