"""The likelihood of one image row: haze, then the stripe, then less.

Input: the counts of a row, and the light that a model expects. Output: the probability of each position of the stripe;
from the rows of a sweep, a model. `likelihood` is the exact form and the specification of the fast ones; `model` and
`inputs` hold its parameters, `em` and `ambient` learn them. `neighbours` compares answers with those around them, and
`confidence` says from that how far an answer of `likelihood` can be believed.
"""
