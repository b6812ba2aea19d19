"""Unit tests of the stripe estimators."""
