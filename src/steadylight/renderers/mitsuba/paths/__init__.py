"""Camera paths: shading a frame from the cache, and the coverage audit that walks the same paths beforehand.

Both branch alike at glass, specular layers and gloss, because random numbers belong to a place on the path, not to the
order of calls.
"""
