"""From frames to counts: assigns each frame to its column and sweep, and adds up detections without unpacking a bit."""
