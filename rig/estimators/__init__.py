"""Stripe estimators: argmax, edge, likelihood."""
