"""The likelihood of one image row: haze, then the stripe, then less.

`likelihood` is the exact form and the specification of the fast ones; `model` and `inputs` hold its parameters, `em`
and `ambient` learn them from a sweep. `neighbours` compares answers with those around them.
"""
