"""A sweep's picture and its passages (when the line's centre crossed each pixel), from the counts of its columns.

Input: the counts of a sweep and the mirror command of each column. Output: the passages, which are mirror commands with
standard deviations, and the picture in photons per pixel and exposure. `find` chooses pixels, `fit` fits a passage.
"""
