"""From videos to what may be a ball, frame by frame."""
