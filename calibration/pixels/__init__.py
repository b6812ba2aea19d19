"""From dark frames to hot, noisy and dead pixels, and how they drift."""
