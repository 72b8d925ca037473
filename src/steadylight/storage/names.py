"""Names of the files of a run."""

from __future__ import annotations

from pathlib import Path


class RunFiles:
    """Where each file of a run is; nothing here touches the disk.

    Attributes:
        root: the run directory, as given.
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)

    @property
    def run_file(self) -> Path:
        """`run.json`: everything that determines the bytes of the frames."""
        return self.root / "run.json"

    @property
    def stats_file(self) -> Path:
        """`stats.json`: statistics of the run."""
        return self.root / "stats.json"

    @property
    def display_file(self) -> Path:
        """`display.json`: how video and pictures are made from the frames."""
        return self.root / "display.json"

    @property
    def pictures(self) -> Path:
        """`pictures/`: 8-bit pictures of the frames, if they were asked for."""
        return self.root / "pictures"

    def picture(self, number: int) -> Path:
        """Path of the picture of frame `number`."""
        return self.pictures / f"frame_{number:05d}.png"

    @property
    def video_file(self) -> Path:
        """`animation.mp4`."""
        return self.root / "animation.mp4"

    @property
    def report_file(self) -> Path:
        """`report.html`."""
        return self.root / "report.html"

    @property
    def journal_file(self) -> Path:
        """`log/tasks.jsonl`: one line for each task attempt."""
        return self.root / "log" / "tasks.jsonl"

    @property
    def notes(self) -> Path:
        """`log/performed/`: a file for each attempt of `steadylight perform` that is not in the journal yet."""
        return self.root / "log" / "performed"

    @property
    def lock_file(self) -> Path:
        """`log/lock`: held by the command that uses the directory; names its host and process."""
        return self.root / "log" / "lock"

    @staticmethod
    def frame_name(number: int) -> str:
        """Name of a frame relative to the run directory, `frames/frame_00001.exr` for number 1."""
        return f"frames/frame_{number:05d}.exr"

    def frame(self, number: int) -> Path:
        """Path of frame `number`, counted from 1."""
        return self.root / self.frame_name(number)

    @property
    def aovs(self) -> Path:
        """`aovs/`: depth, normal and position of what the pixels of each frame see, if they were asked for."""
        return self.root / "aovs"

    @staticmethod
    def aovs_name(number: int) -> str:
        """Name of a frame's AOVs relative to the run directory, `aovs/frame_00001.exr` for number 1."""
        return f"aovs/frame_{number:05d}.exr"

    @staticmethod
    def cache_name(name: str) -> str:
        """Name of a renderer's file relative to the run directory, `cache/<name>`."""
        return f"cache/{name}"

    @staticmethod
    def result_name(key: str) -> str:
        """Name of a task's result relative to the run directory; always written last."""
        return f"log/results/{key}.json"
