"""The renderer on Radiance's own program `rtrace`: the system that the paper was built on.

Scenes are octrees, caches are ambient files; pyradiance provides the programs.
"""
