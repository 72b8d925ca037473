"""Reads USD files.

`isolation` starts a process of its own, where `reading` makes a scene description of a stage by OpenUSD's library.
Contains what that takes: meshes, shader networks, lights and cameras.
"""
