"""Numerical stability: hard input, no warning, no NaN where an answer is promised."""
