"""Models of the devices' firmware: bytes in, bytes out, written from manuals and public sources.

Input: the bytes or calls of a host, and the time. Output: answers, and what the device does meanwhile: its emission,
its output levels, the motion of its mirror or its frames.
"""
