"""The estimator `joint`: the likelihood of every row, tied to its neighbours in rows and columns.

Input: the counts of a sweep and its geometry. Output: a stripe table with second stripes, and the learned model.
Order of work: `labels` gives every candidate position of a row and column a cost in bytes; `paths` and `winner` pick
the cheapest positions along rows and columns; `vote` corrects weak answers and `place` refines answers to sub-pixel
positions; `confidence` judges answers by their neighbours; `lesson` and `halo` learn from answers for the next map.
"""
