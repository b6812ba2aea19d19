"""Effects on the light between laser and sensor, one file each; an effect that a scene does not call for is not
imported.
"""
