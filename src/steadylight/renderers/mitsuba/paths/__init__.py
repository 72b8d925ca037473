"""Camera paths: shading a frame from the cache, and the coverage audit, which follows the same paths beforehand.

Both branch identically at glass, specular layers and glossy surfaces, because random numbers belong to a position on
the path, not to the order of calls.
"""
