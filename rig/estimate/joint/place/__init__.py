"""Sub-pixel positions: each stripe is placed by its own counts and by those of neighbours on the same surface."""
