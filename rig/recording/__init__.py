"""Recordings: SPB1 segments with an index, written while a run goes on; reading, checking and mending them."""
