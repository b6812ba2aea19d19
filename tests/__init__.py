"""Tests of spadrig."""
