"""Random rigs calibrated: depth error beside what is stated, mistakes beside what they are called."""
