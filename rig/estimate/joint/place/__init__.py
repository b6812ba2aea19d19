"""Sub-pixel positions of stripes, from their own counts and those of neighbours on the same surface."""
