"""Physical effects, the registry that names them, and effects of one's own."""
