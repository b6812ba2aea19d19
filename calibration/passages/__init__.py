"""From the counts of a sweep to its picture, and to when the line's centre crossed each pixel."""
