"""Reader of glTF 2.0 and GLB files.

Contains the checked document (`schema`, `document`), nodes and curves, materials, meshes, lamps and cameras; `reader`
puts them together.
"""

from steadylight.scenes.gltf.reader import read

__all__ = ["read"]
