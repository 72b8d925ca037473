"""Artworks of the gallery: paintings as small images, and sculptures as meshes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from steadylight.scenes.furnishings import Floats, Mesh, join, lathe, sheet, tube
from steadylight.scenes.textures import Picture, clouds

if TYPE_CHECKING:
    from collections.abc import Sequence

RGB = tuple[float, float, float]


def _finished(image: Floats, rng: np.random.Generator) -> Picture:
    """The image with a slight texture of canvas and brush strokes, clipped to the albedo of paint."""
    from scipy.ndimage import gaussian_filter  # SciPy takes longer to load than `plan` needs

    height, width = image.shape[:2]
    weave = gaussian_filter(rng.normal(size=(height, width)), 0.7)
    brush = gaussian_filter(rng.normal(size=(height, width)), (1.0, 9.0))
    image = image * (1.0 + 0.06 * weave / weave.std() + 0.05 * brush / brush.std())[..., None]
    return np.asarray(np.clip(image, 0.02, 0.85), dtype=np.float32)


def _grid(width: int, height: int) -> tuple[Floats, Floats]:
    """Pixel centres: x from 0 to width/height to the right, y from 0 at the top to 1."""
    y, x = np.mgrid[0:height, 0:width]
    return (x + 0.5) / height, (y + 0.5) / height


def colour_field(
    seed: int, ground: RGB, blocks: Sequence[RGB], size: tuple[int, int] = (192, 256)
) -> Picture:
    """Stacked blocks of colour with soft edges on a ground."""
    rng = np.random.default_rng(seed)
    width, height = size
    x, y = _grid(width, height)
    aspect = width / height
    image = np.broadcast_to(np.array(ground), (height, width, 3)).copy()
    edges = np.linspace(0.06, 0.94, len(blocks) + 1)
    waver = 0.006 * clouds(rng, size, (6, 6))
    for block, top, bottom in zip(blocks, edges, edges[1:], strict=False):
        inside = np.minimum.reduce([x - 0.08, aspect - 0.08 - x, y - top - 0.02, bottom - 0.02 - y]) + waver
        cover = 1.0 / (1.0 + np.exp(-inside / 0.012))
        cover = cover * (0.86 + 0.07 * clouds(rng, size, (3, 3)))
        image += np.clip(cover, 0.0, 1.0)[..., None] * (np.array(block) - image)
    return _finished(image, rng)


def circles(seed: int, palette: Sequence[RGB], size: tuple[int, int] = (256, 192)) -> Picture:
    """Discs, rings and crossing lines on a pale ground."""
    rng = np.random.default_rng(seed)
    width, height = size
    x, y = _grid(width, height)
    image = np.broadcast_to(np.array([0.68, 0.63, 0.52]), (height, width, 3)).copy()
    for k in range(26):
        tint = np.array(palette[k % len(palette)])
        centre = rng.uniform([0.05, 0.05], [width / height - 0.05, 0.95])
        radius = rng.uniform(0.03, 0.24) * (1.0 if k < 12 else 0.5)
        distance = np.hypot(x - centre[0], y - centre[1])
        if k % 3 == 2:
            distance = radius * 1.1 + np.abs(distance - radius) - 0.012
        cover = np.clip((radius * 1.1 - distance) * height, 0.0, 1.0) * rng.uniform(0.6, 1.0)
        image += cover[..., None] * (tint - image)
    for _ in range(9):
        angle, offset = rng.uniform(0.0, np.pi), rng.uniform(0.2, 0.8)
        line = np.abs((x - offset * width / height) * np.sin(angle) - (y - offset) * np.cos(angle))
        image += np.clip((0.004 - line) * height, 0.0, 1.0)[..., None] * (0.03 - image)
    return _finished(image, rng)


def lattice(seed: int, size: tuple[int, int] = (224, 224)) -> Picture:
    """Black bars, white fields, and a few in plain colours."""
    rng = np.random.default_rng(seed)
    width, height = size
    image = np.broadcast_to(np.array([0.74, 0.73, 0.69]), (height, width, 3)).copy()
    plain = np.array([[0.55, 0.04, 0.03], [0.03, 0.07, 0.34], [0.72, 0.5, 0.05]])
    columns = np.concatenate([[0], np.sort(rng.choice(np.arange(24, width - 24, 28), 4, False)), [width]])
    rows = np.concatenate([[0], np.sort(rng.choice(np.arange(24, height - 24, 28), 4, False)), [height]])
    for k in rng.choice(25, 8, replace=False):
        i, j = divmod(int(k), 5)
        image[rows[i] : rows[i + 1], columns[j] : columns[j + 1]] = plain[k % 3]
    for row in rows[1:-1]:
        image[row - 3 : row + 4] = 0.03
    for column in columns[1:-1]:
        image[:, column - 3 : column + 4] = 0.03
    return _finished(image, rng)


def landscape(seed: int, sky: RGB, land: RGB, size: tuple[int, int] = (256, 160)) -> Picture:
    """Mountain ridges in haze under an evening sky."""
    rng = np.random.default_rng(seed)
    width, height = size
    _, y = _grid(width, height)
    glow = np.array([0.8, 0.55, 0.3])
    t = np.clip(y / 0.6, 0.0, 1.0)[..., None] ** 2
    image = (1.0 - t) * np.array(sky) + t * glow
    image *= (1.0 + 0.12 * clouds(rng, size, (3, 3)))[..., None]
    for layer in range(5):
        ridge = 0.5 * clouds(rng, size, (2 + layer, 2 + layer))[0]
        horizon = 0.42 + 0.12 * layer + (0.07 + 0.01 * layer) * ridge
        near = (layer + 1) / 5
        tint = near * np.array(land) + (1.0 - near) * 0.6 * (glow * 0.5 + np.array(sky) * 0.5)
        tint = tint * (1.0 + 0.15 * clouds(rng, size, (12, 12)))[..., None]
        cover = np.clip((y - horizon) * height, 0.0, 1.0)[..., None]
        image += cover * (tint - image)
    return _finished(image, rng)


def gestures(seed: int, ground: RGB, palette: Sequence[RGB], size: tuple[int, int] = (256, 208)) -> Picture:
    """Broad sweeping brush strokes that become thinner."""
    from scipy.spatial import KDTree  # SciPy takes longer to load than `plan` needs

    rng = np.random.default_rng(seed)
    width, height = size
    x, y = _grid(width, height)
    image = np.array(ground) * (1.0 + 0.1 * clouds(rng, size, (4, 4)))[..., None]
    for k in range(34):
        centre = rng.uniform([0.1, 0.1], [width / height - 0.1, 0.9])
        swing = np.array([rng.uniform(0.1, 0.5), rng.uniform(0.05, 0.4)])
        t = rng.uniform(0.0, 2.0 * np.pi) + np.linspace(0.0, rng.uniform(1.5, 4.5), 500)
        path = centre + swing * np.stack([np.cos(t), np.sin(1.3 * t)], 1)
        breadth = rng.uniform(0.012, 0.05) * (1.0 - k / 45)
        distance = KDTree(path).query(np.stack([x, y], -1), distance_upper_bound=0.08)[0]
        distance = np.minimum(distance, 0.08)
        bristles = 0.75 + 0.25 * np.sin(900.0 * distance + 1.5 * clouds(rng, size, (8, 8)))
        cover = np.clip((breadth - distance) * height / 2.0, 0.0, 1.0) * bristles
        image += cover[..., None] * (np.array(palette[k % len(palette)]) - image)
    return _finished(image, rng)


def bands(seed: int, palette: Sequence[RGB], size: tuple[int, int] = (256, 128)) -> Picture:
    """Vertical bands of unequal width."""
    rng = np.random.default_rng(seed)
    width, height = size
    edges = np.cumsum(rng.choice([2, 3, 5, 8, 13, 21], 60))
    pick = rng.integers(0, len(palette), 61)
    column = np.array(palette)[pick[np.searchsorted(edges, np.arange(width), side="right")]]
    return _finished(np.broadcast_to(column, (height, width, 3)) * 1.0, rng)


def knot(turns: int = 3, windings: int = 2) -> Mesh:
    """A torus knot, 0.9 m across, standing on its edge on z = 0."""
    t = np.linspace(0.0, 2.0 * np.pi, 420, endpoint=False)
    ring = 0.27 + 0.115 * np.cos(turns * t)
    path = np.stack(
        [0.9 * 0.115 * np.sin(turns * t), ring * np.cos(windings * t), ring * np.sin(windings * t)], 1
    )
    mesh = tube(path, 0.052 + 0.012 * np.cos(turns * t + 1.0), sides=26, closed=True)
    return mesh.moved(z=-float(mesh.vertices[:, 2].min()) - 0.004)


def _bump(azimuth: Floats, elevation: Floats, at: tuple[float, float], width: tuple[float, float]) -> Floats:
    """A Gaussian bump over directions; all angles in degrees."""
    turn = (azimuth - at[0] + 180.0) % 360.0 - 180.0
    return np.exp(-0.5 * ((turn / width[0]) ** 2 + ((elevation - at[1]) / width[1]) ** 2))


def bust() -> Mesh:
    """A head on neck and shoulders, facing +x; 0.55 m high, standing on z = 0."""
    elevation = np.linspace(-90.0, 90.0, 100)[:, None]
    azimuth = np.linspace(-180.0, 180.0, 140, endpoint=False)[None, :]
    features = (
        (0.300, (0.0, -9.0), (6.5, 7.0)),  # nose: tip, bridge
        (0.130, (0.0, 4.0), (5.0, 9.0)),
        (0.075, (0.0, 21.0), (26.0, 7.0)),  # brow
        (-0.100, (21.0, 10.0), (9.0, 6.0)),  # eye sockets and lids
        (-0.100, (-21.0, 10.0), (9.0, 6.0)),
        (0.055, (20.0, 9.5), (4.5, 3.0)),
        (0.055, (-20.0, 9.5), (4.5, 3.0)),
        (0.050, (40.0, -6.0), (13.0, 10.0)),  # cheekbones
        (0.050, (-40.0, -6.0), (13.0, 10.0)),
        (0.090, (0.0, -25.0), (11.0, 3.0)),  # lips
        (0.085, (0.0, -32.0), (9.0, 3.0)),
        (-0.045, (0.0, -28.5), (14.0, 1.6)),
        (0.130, (0.0, -46.0), (13.0, 8.0)),  # chin
        (0.160, (90.0, 2.0), (5.5, 12.0)),  # ears
        (0.160, (-90.0, 2.0), (5.5, 12.0)),
        (0.230, (180.0, 20.0), (26.0, 20.0)),  # knot of hair
        (-0.160, (180.0, -45.0), (70.0, 26.0)),  # nape
    )
    relief = sum(height * _bump(azimuth, elevation, at, width) for height, at, width in features)
    hair = _bump(azimuth, elevation, (180.0, 40.0), (75.0, 38.0))
    waves = 0.028 * hair * np.sin(np.radians(7.0 * azimuth + 9.0 * elevation))
    poles = 1.0 - np.abs(np.sin(np.radians(elevation))) ** 24  # at the poles, all azimuths must agree
    radius = 1.0 + poles * (relief + waves + 0.06 * hair)
    a, e = np.radians(azimuth), np.radians(elevation)
    head = np.stack(
        np.broadcast_arrays(
            0.098 * radius * np.cos(e) * np.cos(a),
            0.080 * radius * np.cos(e) * np.sin(a),
            0.128 * radius * np.sin(e),
        ),
        -1,
    )
    head[..., 0] += 0.015
    head[..., 2] += 0.415
    return join([sheet(head, wrap_columns=True), _shoulders()])


def _shoulders() -> Mesh:
    """Neck and shoulders, cut off straight across the chest."""
    from scipy.ndimage import gaussian_filter  # SciPy takes longer to load than `plan` needs

    angle = np.linspace(-np.pi, np.pi, 96, endpoint=False)
    z = np.array([-0.004, 0.0, 0.04, 0.09, 0.14, 0.175, 0.2, 0.22, 0.245, 0.28, 0.32, 0.36])
    wide = np.array([0.135, 0.14, 0.175, 0.205, 0.214, 0.198, 0.16, 0.11, 0.075, 0.064, 0.06, 0.055])
    deep = np.array([0.095, 0.1, 0.112, 0.12, 0.116, 0.105, 0.09, 0.076, 0.066, 0.062, 0.062, 0.058])
    fine = np.linspace(z[0], z[-1], 60)
    wide, deep = (gaussian_filter(np.interp(fine, z, values), 1.5) for values in (wide, deep))
    rings = np.stack(
        np.broadcast_arrays(
            deep[:, None] * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.9,
            wide[:, None] * np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** 0.9,
            fine[:, None],
        ),
        -1,
    )
    rings[..., 0] += 0.03 * np.clip((fine - 0.2) / 0.15, -0.4, 1.0)[:, None] - 0.01
    return sheet(rings, wrap_columns=True)


def supershape() -> Mesh:
    """A ribbed, star-shaped body after Gielis' superformula (2003); 0.6 m across, standing on z = 0."""
    theta = np.linspace(-np.pi, np.pi, 168, endpoint=False)
    phi = np.linspace(-np.pi / 2, np.pi / 2, 84)

    def gielis(angle: Floats, m: float, n1: float, n2: float) -> Floats:
        around = np.abs(np.cos(m * angle / 4.0)) ** n2 + np.abs(np.sin(m * angle / 4.0)) ** n2
        return around ** (-1.0 / n1)

    r1, r2 = gielis(theta, 7.0, 1.6, 3.2)[None, :], gielis(phi, 3.0, 2.4, 2.7)[:, None]
    r1 = r1 / r1.max()
    p = phi[:, None]
    twist = 0.7 * np.sin(p)
    body = np.stack(
        np.broadcast_arrays(
            0.3 * r1 * np.cos(theta + twist) * r2 * np.cos(p),
            0.3 * r1 * np.sin(theta + twist) * r2 * np.cos(p),
            0.34 * r2 * np.sin(p),
        ),
        -1,
    )
    mesh = sheet(body, wrap_columns=True)
    return mesh.moved(z=-float(mesh.vertices[:, 2].min()) - 0.01)


def flame(height: float = 1.5) -> Mesh:
    """An upright twisted form that swells and narrows, standing on z = 0."""
    t = np.linspace(0.0, 1.0, 110)[:, None]
    angle = np.linspace(-np.pi, np.pi, 72, endpoint=False)[None, :]
    swell = 0.13 + 0.13 * np.sin(np.pi * t**0.8) ** 2 - 0.09 * t
    swell = swell * np.clip((1.0 - t) / 0.06, 0.0, 1.0) ** 0.5
    turn = 2.6 * t
    lobes = 1.0 + 0.28 * np.cos(2.0 * (angle - turn)) + 0.08 * np.cos(3.0 * (angle + 0.6 * turn))
    bend = 0.09 * np.sin(2.0 * np.pi * t)
    rings = np.stack(
        np.broadcast_arrays(
            swell * lobes * np.cos(angle) + bend, swell * lobes * np.sin(angle), height * t - 0.004
        ),
        -1,
    )
    return sheet(rings, wrap_columns=True)


def pebble(seed: int, size: float = 0.34) -> Mesh:
    """A smooth biomorphic form with a few bulges, standing on z = 0."""
    rng = np.random.default_rng(seed)
    elevation = np.linspace(-90.0, 90.0, 90)[:, None]
    azimuth = np.linspace(-180.0, 180.0, 120, endpoint=False)[None, :]
    radius = np.ones((90, 120))
    for _ in range(7):
        at = (rng.uniform(-180.0, 180.0), rng.uniform(-50.0, 60.0))
        spread = rng.uniform(17.0, 34.0)
        squeeze = max(float(np.cos(np.radians(at[1]))), 0.5)
        fade = np.cos(np.radians(elevation)) ** 2  # a bump must not wrap over the poles
        radius = radius + rng.uniform(-0.35, 0.75) * fade * _bump(
            azimuth, elevation, at, (spread / squeeze, spread)
        )
    a, e = np.radians(azimuth), np.radians(elevation)
    points = (
        size
        * radius[..., None]
        * np.stack(
            np.broadcast_arrays(np.cos(e) * np.cos(a), 0.8 * np.cos(e) * np.sin(a), 1.1 * np.sin(e)), -1
        )
    )
    mesh = sheet(points, wrap_columns=True)
    return mesh.moved(z=-float(mesh.vertices[:, 2].min()) - 0.012)


def vase(belly: float, height: float) -> Mesh:
    """A pot, turned on a wheel, with a rim and an inside."""
    t = np.linspace(0.0, 1.0, 40)
    outside = belly * (
        0.42 + 0.62 * np.sin(np.pi * t**0.75) ** 1.3 + 0.12 * np.clip(t - 0.85, 0.0, 1.0) / 0.15
    )
    z = height * t
    lip, inner = outside[-1], outside - 0.012
    return lathe(
        np.stack([outside, z - 0.003], 1),
        [(float(lip), height - 0.003), (float(inner[-1]), height - 0.003)],
        np.stack([inner, z - 0.003], 1)[::-1][:-2],
        [(float(inner[2]), float(z[2]) - 0.003), (0.0, float(z[2]) - 0.003)],
        segments=56,
    )
