"""The renderer on Radiance's own programs, `rtrace` and `rpict`: the system that the paper was built on.

Scenes are octrees, caches are ambient files; pyradiance brings the programs.
"""
