"""Verdicts: what the data and the fit show, held against limits; the first reason is the cause."""
