"""From frames to counts: assigns each frame to a sweep and column, and adds up detections without unpacking bits."""
