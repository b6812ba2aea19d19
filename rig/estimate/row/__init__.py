"""The likelihood of one image row: haze, then the stripe, then nothing.

`likelihood` is the exact form and the specification of all faster ones; `model` and `inputs` are what it depends on,
`em` learns the model's background from a sweep.
"""
