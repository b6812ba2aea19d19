"""The scenes in front of the simulated rig.

Input: the name or file of a scene, and the rays of a camera. Output: depth and albedo of each pixel, and the medium:
how fog, smoke, rain or snow weaken and scatter light.
"""
