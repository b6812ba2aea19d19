"""The folder that a run leaves, which appears whole or not at all: maps, pictures, clouds, manifest and summary."""
