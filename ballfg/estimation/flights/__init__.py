"""Flights are found in recordings: which samples show a flying ball, and which one that is held, rolls or rests.

`label_samples` labels the samples of a track, `flights` cuts its flights out. The model and its numbers are in
docs/derivations/segmentation.md.
"""
