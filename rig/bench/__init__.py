"""`rig bench`: measures in one run how fast this machine counts and estimates, and how fast it reads its memory.

Input: synthetic frames (`frames`) or simulated ones, and how much to measure. Output: a report of speeds and errors.
`speed` measures the rows of its table, and `latency` the time from a column's last frame to its estimate. `soak` plays
a long stream through the acquisition itself. Speeds are medians over rounds. Each round measures every row in turn, so
a machine that slows down or has other work slows all of them alike. Ratios are of figures from one run.
"""
