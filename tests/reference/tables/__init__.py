"""Programs that print a table of what estimators make of the yardstick's counts, and what they share."""
