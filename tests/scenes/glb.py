"""Writes small glTF files for tests."""

from __future__ import annotations

import json
import struct

import numpy as np

KINDS = {"float32": 5126, "uint16": 5123, "uint32": 5125, "uint8": 5121, "int8": 5120, "int16": 5122}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class Glb:
    """A document that grows, with a binary chunk.

    Attributes:
        document: the document.
    """

    def __init__(self, **document):
        self.document = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}], **document}
        self.binary = bytearray()

    def add(self, kind, **entry):
        """Append to a list of the document; gives the index."""
        entries = self.document.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def view(self, data):
        """Append bytes; gives the index of the buffer view."""
        while len(self.binary) % 4:
            self.binary.append(0)
        start = len(self.binary)
        self.binary += bytes(data)
        return self.add("bufferViews", buffer=0, byteOffset=start, byteLength=len(data))

    def array(self, values, dtype="float32", *, normalized=False):
        """Append an array, (N,) or (N, W); gives the index of the accessor."""
        values = np.atleast_1d(np.asarray(values, dtype))
        width = 1 if values.ndim == 1 else values.shape[1]
        more = {"normalized": True} if normalized else {}
        return self.add(
            "accessors",
            bufferView=self.view(values.tobytes()),
            componentType=KINDS[dtype],
            count=len(values),
            type=SHAPES[width],
            **more,
        )

    def image(self, encoded):
        """Append an image file; gives the index of the texture."""
        number = self.add("images", bufferView=self.view(encoded), mimeType="image/png")
        return self.add("textures", source=number)

    def node(self, *, top=True, **entry):
        """Append a node, to the scene if it is at the top; gives its index."""
        index = self.add("nodes", **entry)
        if top:
            self.document["scenes"][0]["nodes"].append(index)
        return index

    def square(self, size=1.0, material=None, **attributes):
        """Append a mesh: a square in x and y from -size to size that faces +z; gives its index."""
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * size
        primitive = {
            "attributes": {"POSITION": self.array(corners)}
            | {name: self.array(values) for name, values in attributes.items()},
            "indices": self.array([0, 1, 2, 0, 2, 3], "uint16"),
        }
        return self.add(
            "meshes", primitives=[primitive if material is None else primitive | {"material": material}]
        )

    def light(self, **light):
        """Append a lamp; gives the node extension."""
        table = self.document.setdefault("extensions", {}).setdefault("KHR_lights_punctual", {"lights": []})
        table["lights"].append(light)
        return {"KHR_lights_punctual": {"light": len(table["lights"]) - 1}}

    def animate(self, target, times, values, interpolation="LINEAR"):
        """Append an animation of one channel."""
        values = np.asarray(values, float)
        sampler = {
            "input": self.array(times),
            "output": self.array(
                values.ravel() if values.ndim == 1 else values.reshape(-1, values.shape[-1])
            ),
            "interpolation": interpolation,
        }
        self.add("animations", channels=[{"sampler": 0, "target": target}], samplers=[sampler])

    def bytes(self):
        """The file."""
        document = dict(self.document)
        if self.binary:
            document["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(document, ensure_ascii=False).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.binary) + bytes(-len(self.binary) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        if binary:
            chunks += struct.pack("<II", len(binary), 0x004E4942) + binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def write(self, path):
        """Write the file; gives its path."""
        path.write_bytes(self.bytes())
        return path


def rotation(axis, angle):
    """Quaternion x, y, z, w of a turn by an angle in radians."""
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return [*(np.sin(angle / 2) * axis).tolist(), float(np.cos(angle / 2))]


def triangle(uri):
    """A document of one triangle, whose positions are the 36 bytes of a file."""
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": uri, "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
