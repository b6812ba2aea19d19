"""Inputs from strangers: every parser takes random damage and forgeries and ends in its answer or an error of ours."""
