"""Kernels that a film compiles in a process that finds none in Dr.Jit's cache, and how long that takes.

    python benchmarks/kernels.py [SCENE] [--frames 3] [--size 96x54] [--most 12] [--json FILE]

The film is rendered by one process with an empty home directory. Each kernel counts once, whatever the number of its
launches.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from pathlib import Path
from typing import Any

from provenance import provenance


def compiled(scene: str, frames: int, size: str, output: Path) -> list[dict[str, Any]]:
    """Render a film; returns the kernels that it needed, those first that took longest to compile."""
    from steadylight.renderers.mitsuba.backend import resolve_variant, use_variant

    use_variant(resolve_variant("auto"))
    import drjit as dr

    import steadylight

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        steadylight.render(
            scene, frames=frames, size=size, quality="draft", cluster="in-process", output=output
        )
        launches = dr.kernel_history([dr.KernelType.JIT])
    found: dict[str, dict[str, Any]] = {}
    for launch in launches:
        if not launch["cache_hit"]:
            told = {
                "operations": launch["operation_count"],
                "seconds": launch["codegen_time"] / 1e3 + launch["backend_time"] / 1e3,
            }
            found.setdefault(str(launch["hash"]), told)
    return sorted(found.values(), key=lambda kernel: -float(kernel["seconds"]))


def main() -> None:
    """Render with an empty home directory, and print what was compiled."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", nargs="?", default="gallery")
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--size", default="96x54")
    parser.add_argument("--most", type=int, default=12, help="kernels printed one by one")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["HOME"] = folder  # Dr.Jit, which is not loaded yet, keeps its kernels there
        kernels = compiled(given.scene, given.frames, given.size, Path(folder) / "run")
    seconds = sum(kernel["seconds"] for kernel in kernels)
    print(f"{len(kernels)} kernels, {seconds:.1f} s; the longest:")
    for kernel in kernels[: given.most]:
        print(f"{kernel['seconds']:7.2f} s {kernel['operations']:7d} operations")
    if given.json:
        content = {"provenance": provenance(), "scene": given.scene, "kernels": kernels}
        given.json.write_text(json.dumps(content, indent=1))


if __name__ == "__main__":
    main()
