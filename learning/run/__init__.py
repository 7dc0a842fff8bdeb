"""A training run: the loop, its checkpoints, its folder, its processes."""
