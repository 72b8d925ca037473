"""Radiance's scenes: `octree` keeps them for Radiance's own programs, `conversion` turns them into Mitsuba's.

Both read text by `grammar` and run the commands in it by `commands`: known programs only, and no shell.
"""
