"""What an estimator makes of the yardstick's counts: programs that print a table, and what they share."""
