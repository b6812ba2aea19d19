"""Effects on laser light, other light and the sensor's bits. A module is imported only if a scene has its effect.

Input: a `Setting`, which is the rig in its scene; for the laser's light also a light sheet, for bits the frames.
Output: detections per second and watt, or per second, of each pixel; or changed bits. `catalogue` lists all effects.
"""
