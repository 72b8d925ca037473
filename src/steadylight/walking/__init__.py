"""Walking: camera paths among the surfaces of a scene. Makes walks at eye height, and checks any path.

It sees a scene only through rays (`renderers.base.Geometry`).
"""
