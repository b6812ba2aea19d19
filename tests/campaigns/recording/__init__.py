"""Recordings that are killed and damaged."""
