"""The laser's light in the scene: sheets and lines, what the camera sees of them, optics.

Input: surfaces, a rig model, lens and sensor, and mirror commands. Output: a `CameraView`, light sheets with the place
on each row where their light ends, the width of the line, and detections per radiance.
"""
