"""Costs of the candidate positions (labels) of every row and column, in bytes, by the terms of the row likelihood."""
