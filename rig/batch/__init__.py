"""Computes many independent cases: on the cores of this computer, on a dask cluster, or a share of them in each of
several jobs.

Input: cases, each a function with its inputs. Output: a folder with one table; an interrupted batch goes on in it.
Begin reading at `engine`.
"""
