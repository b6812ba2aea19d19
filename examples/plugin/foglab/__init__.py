"""A lab's own device and estimator for spadrig, found by entry points."""
