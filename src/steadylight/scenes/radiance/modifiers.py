"""Resolves modifiers: surfaces with the materials, patterns and textures that were defined before them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from steadylight.errors import SceneError
from steadylight.scenes.radiance.grammar import VOID, Primitive
from steadylight.scenes.radiance.materials import LIGHTS, MATERIALS
from steadylight.scenes.radiance.surfaces import SURFACES, fault

PATTERNS = (
    "brightfunc",
    "brightdata",
    "brighttext",
    "colorfunc",
    "colordata",
    "colorpict",
    "colortext",
    "spectrum",
    "specfunc",
    "specfile",
    "specdata",
    "specpict",
)
TEXTURES = ("texfunc", "texdata")
MIXTURES = ("mixfunc", "mixdata", "mixpict", "mixtext")


@dataclass(frozen=True, eq=False)
class Modifier:
    """A material, pattern, texture or mixture.

    Attributes:
        primitive: primitive of the modifier.
        below: the modifier that modifies it, or None.
        mixed: for a mixture, the modifiers that it mixes; None for `void`.
    """

    primitive: Primitive
    below: Modifier | None = None
    mixed: tuple[Modifier | None, ...] = ()

    def chain(self) -> Iterator[Modifier]:
        """Everything that it depends on, each once and after its own dependencies; the modifier itself comes last."""
        waiting: list[tuple[Modifier, bool]] = [(self, False)]
        given: set[Modifier] = set()
        while waiting:
            each, ready = waiting.pop()
            if each in given:
                continue
            if ready:
                given.add(each)
                yield each
                continue
            waiting.append((each, True))
            needed = [each.below, *each.mixed]
            waiting += [(other, False) for other in reversed(needed) if other is not None]

    @property
    def patterns(self) -> list[Modifier]:
        """The patterns below it."""
        found, each = [], self.below
        while each is not None:
            found += [each] if each.primitive.kind in PATTERNS else []
            each = each.below
        return found

    def pattern_names(self) -> str:
        """Names of the patterns below it, for messages."""
        names = [each.primitive.name for each in self.patterns]
        return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


@dataclass(frozen=True)
class Surface:
    """A surface and its modifier; None for `void`."""

    primitive: Primitive
    modifier: Modifier | None


def renamed(modifiers: Iterable[Modifier]) -> tuple[list[Primitive], dict[Modifier, str]]:
    """Modifiers as primitives with unique names, and these names.

    Without unique names, a later modifier of the same name would change the meaning of earlier ones. Light sources lose
    their string arguments, such as a substitute material.

    Args:
        modifiers: modifiers in order of dependency, as in `Modifier.chain`; some may be repeated.
    """
    names: dict[Modifier, str] = {}
    found = []
    for each in modifiers:
        if each in names:
            continue
        names[each] = f"m{len(names)}"
        below = VOID if each.below is None else names[each.below]
        mixed = tuple(VOID if other is None else names[other] for other in each.mixed)
        words = () if each.primitive.kind in LIGHTS else mixed + each.primitive.words[len(mixed) :]
        found.append(replace(each.primitive, modifier=below, name=names[each], words=words))
    return found, names


def surfaces_of(primitives: Iterable[Primitive]) -> list[Surface]:
    """Surfaces with their modifiers; a name refers to the last definition before it.

    Raises:
        SceneError: a modifier is not defined, or a type is unknown.
    """
    known: dict[str, Modifier] = {}
    found: list[Surface] = []
    for given in primitives:
        modifier = _look_up(known, given.modifier, given)
        if given.kind in (*SURFACES, "source", "instance", "mesh"):
            found.append(Surface(given, modifier))
        else:
            known[given.name] = _modifier(known, given, modifier)
    return found


def _look_up(known: Mapping[str, Modifier], name: str, given: Primitive) -> Modifier | None:
    if name == VOID:
        return None
    if name not in known:
        raise fault(given, f"refers to `{name}`, which is not defined before it")
    return known[name]


def _modifier(known: Mapping[str, Modifier], given: Primitive, below: Modifier | None) -> Modifier:
    """The modifier that a primitive defines."""
    if given.kind == "alias":
        target = _look_up(known, given.words[0], given)
        if target is None:
            raise fault(given, "stands for void; give it a material")
        return target if below is None else Modifier(target.primitive, below, target.mixed)
    if given.kind in MIXTURES:
        if len(given.words) < 2:
            raise fault(given, "does not name two modifiers to mix")
        return Modifier(given, below, tuple(_look_up(known, word, given) for word in given.words[:2]))
    if given.kind in (*MATERIALS, *PATTERNS, *TEXTURES):
        return Modifier(given, below)
    raise SceneError(f"{given.place}: `{given.kind}` is not a Radiance type; is `{given.name}` complete?")
