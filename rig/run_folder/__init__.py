"""The folder with the results of a run: maps, pictures, clouds, manifest and summary. It appears only once it is
complete.
"""
