"""One camera that pans and zooms: the court in its pictures, its motion, and what may be a ball in them."""
