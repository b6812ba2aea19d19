"""A sweep's picture and its passages (when the line's centre crossed each pixel), from the counts of its columns."""
