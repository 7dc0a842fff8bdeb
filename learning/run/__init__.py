"""Runs a training: the loop, its checkpoints, its folder, its processes."""
