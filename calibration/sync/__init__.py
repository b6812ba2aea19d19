"""Lags, row delay and gate delay from a scene that stands still."""
