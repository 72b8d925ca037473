"""Walking: camera paths among the surfaces of a scene. Makes walks at eye height, and checks any path.

It knows a scene only by rays (`renderers.base.Geometry`).
"""
