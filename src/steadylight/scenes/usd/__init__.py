"""Reads USD files.

`isolation` runs OpenUSD's library in a process of its own, where `reading` makes a scene description of a stage.
Contains what that takes: meshes, shader networks, lights and cameras.
"""
