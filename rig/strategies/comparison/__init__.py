"""Compares ways to measure depth: scores answers against the truth, and tabulates them over scenes, media and times.

Input: the config of a simulated rig, and names of strategies. Output: rows with the laser class of each source, a table
of ranges, and two pictures.
"""
