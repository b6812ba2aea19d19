"""Reports: one HTML page each, with text, tables, pictures and charts, that loads nothing from elsewhere.

`page` has the look of all reports, `charts` draws curves. `run_facts` reads what is known of a run, `run` makes the
report on one run or on two side by side, `profiles` draws the image rows in it, and `calibration` makes the report on a
calibration file.
"""
