"""Studies: files that say what varies and what is done, made into cases for the batch engine, and tabulated.

Input: a study's YAML file, or its content. Output: a folder with a table, a figure and a page of all cases.
"""
