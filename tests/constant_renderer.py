"""A renderer whose frames have one colour: all that another package brings to be found as `--renderer constant`."""

from __future__ import annotations

import json

import numpy as np

from steadylight.errors import CacheFileError
from steadylight.renderers.base import Backend, Capabilities, Frame, SceneRenderer, Survey


class ConstantScene(SceneRenderer):
    """A record is the number of the frame that made it; a frame has the colour of their mean."""

    def __init__(self, job):
        self.job = job

    def gather(self, frame, output):
        self._write(output, [frame])
        return {"rays": 1, "hits": 0, "misses": 1, "records": 1}

    def merge(self, caches, part, output):
        records = sorted(number for path in caches for number in json.loads(path.read_text())["records"])
        self._write(output, records)
        return {"records_in": len(caches), "records_out": len(records)}

    def shade(self, frame, caches):
        records = [frame] if caches is None else json.loads(caches[0].read_text())["records"]
        size = (self.job.settings.height, self.job.settings.width, 3)
        return Frame(np.full(size, np.mean(records), np.float32), new_records=int(caches is None))

    def _write(self, output, records):
        output.write_text(json.dumps({"scene": self.job.scene.hash, "records": records}))


class ConstantRenderer:
    name = "constant"
    capabilities = Capabilities(("mitsuba",), ("two-pass", "single-pass"), cache_suffix=".constant")
    cache_files = None

    def check(self, scene, settings, variant, *, build):
        return Backend("numpy", {"numpy": np.__version__})

    def survey(self, job):
        return Survey.undivided(len(job.windows))

    def geometry(self, scene, variant):
        return None

    def validate(self, path, scene_hash):
        if json.loads(path.read_text())["scene"] != scene_hash:
            raise CacheFileError(f"{path}: of another scene")

    def open(self, job, threads):
        return ConstantScene(job)


RENDERER = ConstantRenderer()
