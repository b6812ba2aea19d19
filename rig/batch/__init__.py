"""Computes many independent cases: on the cores of this computer, on a dask cluster, or a share of them in a job.

Input: cases, each a function with its inputs. Output: a folder with one table, which an interrupted batch continues.
Begin reading at `engine`.
"""
