"""Transports that serve the firmware models to the real drivers: pseudo terminals, TCP, HTTP, gRPC, an emulated USB
bus.

Input: a model. Output: the address at which its driver finds it. What the host sends goes to the model, the model's
answers go to the host; the cable can be pulled and the firmware can hang.
"""
