"""Reads USD files.

`isolation` starts a separate process, in which `reading` makes a scene description from a stage with OpenUSD's library.
The other modules convert meshes, shader networks, lights and cameras.
"""
