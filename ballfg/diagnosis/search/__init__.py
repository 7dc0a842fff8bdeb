"""The search: candidate effects scored, refitted and judged, one after the other."""
