"""The renderers, by name: Mitsuba and Radiance here, others through the entry points `steadylight.renderers`.

The rest of the package knows renderers only through the interface in `base`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

from steadylight.errors import CacheFileError, SettingsError

if TYPE_CHECKING:
    from steadylight.renderers.base import CacheFiles, Geometry, Renderer
    from steadylight.scenes.description import SceneDescription

GROUP = "steadylight.renderers"


def renderer_names() -> list[str]:
    """Names that `find_renderer` accepts, in alphabetical order."""
    return sorted({entry.name for entry in entry_points(group=GROUP)})


def find_renderer(name: str) -> Renderer:
    """Load the renderer of that name.

    Raises:
        SettingsError: there is none, or it cannot be loaded.
    """
    for entry in entry_points(group=GROUP, name=name):
        try:
            renderer: Renderer = entry.load()
        except (ImportError, AttributeError) as error:
            raise SettingsError(f"--renderer: {name} cannot be loaded ({error}); install it again") from error
        return renderer
    raise SettingsError(f"--renderer: there is no {name!r}; installed: {', '.join(renderer_names())}")


def renderers_for(scene_format: str) -> list[str]:
    """Names of the renderers that read this scene format (`SceneDescription.format`)."""
    return [renderer.name for renderer in _all() if scene_format in renderer.capabilities.scenes]


def geometry_of(scene: SceneDescription, name: str, variant: str) -> Geometry | None:
    """The surfaces of a scene, from the named renderer if it can provide them, else from another that reads the scene.

    Raises:
        SteadylightError: as `Renderer.check`.
    """
    names = [name, *(other for other in renderers_for(scene.format) if other != name)]
    for each in names:
        geometry = find_renderer(each).geometry(scene, variant)
        if geometry is not None:
            return geometry
    return None


def renderer_of(cache: Path) -> tuple[Renderer, CacheFiles]:
    """The renderer that wrote a cache file, by the file's suffix, and its operations on such files.

    Raises:
        CacheFileError: the suffix belongs to no renderer.
    """
    suffixes = {}
    for renderer in _all():
        if renderer.cache_files is None:
            continue
        suffixes[renderer.capabilities.cache_suffix] = renderer.name
        if cache.suffix == renderer.capabilities.cache_suffix:
            return renderer, renderer.cache_files
    known = ", ".join(f"{suffix} ({name})" for suffix, name in suffixes.items())
    raise CacheFileError(
        f"{cache}: does not have the extension of a cache file; give a file that ends in {known}, for example "
        "one in RUN/cache"
    )


def _all() -> Iterator[Renderer]:
    """Every renderer that can be loaded."""
    for name in renderer_names():
        with suppress(SettingsError):
            yield find_renderer(name)
