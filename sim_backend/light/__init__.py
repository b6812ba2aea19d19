"""The laser's light in the scene: sheets and lines, what the camera sees of them, optics."""
