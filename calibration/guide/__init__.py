"""Which pose of the board to show next, by what it is expected to tell."""
