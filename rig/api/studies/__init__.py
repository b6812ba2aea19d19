"""The calls that do many cases, or one recording in parts: `batch`, `plan_batch`, `repeat_case`, `reconstruct_parts`.

Input: a study, or a recording. Output: a folder with a table of all cases, or the run of the whole recording.
"""
