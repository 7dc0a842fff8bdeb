"""`ballfg-bench estimators`."""
