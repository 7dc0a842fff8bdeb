"""The joint fit of a model to all stretches of a dataset."""
