"""Run folders: configuration, metrics and progress of one command, safe against interruption."""

import contextlib
import dataclasses
import json
import math
import os
import time
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Protocol, Self

import rich.progress
from rich.console import Console

from vertiwm_jax import atomic, config, hosts, trackers
from vertiwm_jax.errors import UserError
from vertiwm_jax.trackers import Events

METRICS = "metrics.jsonl"


class RunError(UserError):
    """A run folder that cannot be read or written; the message names the path."""


class Resumable(Protocol):
    """Settings, a dataclass, of a command whose runs can be resumed.

    runs: folder of runs; resume: folder of the run to resume.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def runs(self) -> Path: ...

    @property
    def resume(self) -> Path | None: ...


class Run:
    """One run's folder: `config.yaml`, `metrics.jsonl`, TensorBoard events, and what doors add.

    Made by `Run.create` and continued by `Run.open`. `outermost` is the folder to resume: that of
    the run that this one is a `part` of, or its own.
    """

    def __init__(self, folder: Path, events: Events) -> None:
        self.folder = folder
        self.outermost = folder
        self._events = events
        self._project: str | None = None
        self._tracker: Any = None

    @classmethod
    def create(cls, root: str | Path, name: str, settings: Any) -> Self:
        """Make `root/name-YYYYmmdd-HHMMSS/` and write the dataclass `settings` into it.

        A folder that cannot be made or written raises `RunError`.
        """
        stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
        try:
            return cls._begin(_make_folder(Path(root), f"{name}-{stamp}"), settings)
        except OSError as error:
            raise RunError(f"{root}: cannot start a run there: {error}") from error

    @classmethod
    def open(cls, folder: str | Path, step: int, settings: Any) -> Self:
        """Continue a run from its checkpoint at `step` with the dataclass `settings`.

        Later metrics are dropped and `config.yaml` is replaced. A folder without metrics, or with
        damaged ones, raises `RunError`.
        """
        folder = Path(folder)
        kept = [entry for entry in read_metrics(folder) if entry["step"] <= step]
        atomic.write(folder / METRICS, "".join(json.dumps(entry) + "\n" for entry in kept))
        atomic.write(folder / "config.yaml", config.dump(settings))
        try:
            events = Events(folder)
            events.restart(step + 1)
        except OSError as error:
            raise RunError(f"{folder}: cannot continue the run: {error}") from error
        return cls(folder, events)

    @classmethod
    def begin(
        cls, settings: Resumable, name: str, step: int = 0, project: str | None = None
    ) -> Self:
        """Create a run with these settings, or continue the one that they name from `step`.

        Of several hosts only the first keeps a folder; the others have temporary ones.
        project: of Weights & Biases, which gets the metrics too; may raise `TrackingError`.
        """
        kept = dataclasses.replace(settings, resume=None)
        if project:
            trackers.check(project)
        if settings.resume is None:
            run = cls.create(hosts.own(settings.runs), name, kept)
        else:
            run = cls.open(hosts.own_copy(settings.resume), step, kept)
        run._track(project, kept)
        return run

    def part(self, name: str, step: int, settings: Any) -> Self:
        """A run in the folder `name` inside this one: made, or continued like `open` does."""
        folder = self.folder / name
        try:
            if (folder / METRICS).is_file():
                part = self.open(folder, step, settings)
            else:
                folder.mkdir(exist_ok=True)
                part = self._begin(folder, settings)
        except OSError as error:
            raise RunError(f"{folder}: cannot start a run there: {error}") from error
        part.outermost = self.outermost
        part._track(self._project, settings)
        return part

    def _track(self, project: str | None, settings: Any) -> None:
        self._project = project
        if project and hosts.is_first():
            self._tracker = trackers.begin(project, self.folder, self.outermost, settings)

    @classmethod
    def _begin(cls, folder: Path, settings: Any) -> Self:
        config.save(settings, folder / "config.yaml")
        (folder / METRICS).touch()
        return cls(folder, Events(folder))

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Record scalars at `step` in `metrics.jsonl` and for TensorBoard.

        Both are on disk, or at least with the operating system, on return. A write that fails
        (a full disk) leaves the earlier lines whole and raises `RunError`.
        """
        now = time.time()
        values = {name: float(value) for name, value in metrics.items()}
        path = self.folder / METRICS
        _append(path, json.dumps({"step": int(step), "wall_time": round(now, 3), **values}) + "\n")
        try:
            self._events.log(int(step), now, values)
        except OSError as error:
            raise RunError(f"{self.folder}: cannot write TensorBoard events: {error}") from error
        if self._tracker:
            self._tracker.log(values, step=int(step))

    def close(self) -> None:
        """Close the TensorBoard file; `metrics.jsonl` is always complete."""
        if self._tracker:
            self._tracker.finish()
        try:
            self._events.close()
        except OSError as error:
            raise RunError(f"{self.folder}: cannot write TensorBoard events: {error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # After a failed write the file cannot be flushed either: the first error is the news.
        with contextlib.suppress(RunError) if error else contextlib.nullcontext():
            self.close()

    @staticmethod
    def progress(total: int, description: str) -> "Progress":
        """A progress display of `total` units, to be used as a context manager."""
        return Progress(total, description)


class Progress:
    """A progress bar with rate and time left on a terminal; elsewhere a plain line now and then.

    Use as a context manager and call `advance`.
    """

    def __init__(self, total: int, description: str, seconds_between_lines: float = 15.0) -> None:
        self._total = total
        self._description = description
        self._interval = seconds_between_lines
        self._console = Console()
        self._done = 0
        self._bar = rich.progress.Progress(
            rich.progress.TextColumn("{task.description}"),
            rich.progress.BarColumn(),
            rich.progress.TextColumn("{task.completed:,.0f}/{task.total:,.0f}"),
            _RateColumn(),
            rich.progress.TimeRemainingColumn(),
            rich.progress.TextColumn("{task.fields[note]}"),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task(description, total=total, note="")

    def __enter__(self) -> Self:
        self._start = self._last = time.monotonic()
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def advance(self, amount: int = 1, note: str = "") -> None:
        """Count `amount` more units as done; `note` is shown beside the rate."""
        self._done += amount
        self._bar.update(self._task, advance=amount, note=note)
        now = time.monotonic()
        due = now - self._last >= self._interval or self._done >= self._total
        if due and not self._console.is_terminal:
            self._last = now
            rate = self._done / max(now - self._start, 1e-9)
            left = max(self._total - self._done, 0) / max(rate, 1e-9)
            print(
                f"{self._description} {self._done:,}/{self._total:,}  {_pace(rate)}  "
                f"{left:,.0f} s left  {note}".rstrip(),
                flush=True,
            )


class _RateColumn(rich.progress.ProgressColumn):
    def render(self, task: rich.progress.Task) -> str:
        return _pace(task.speed or 0.0)


def _pace(rate: float) -> str:
    """The rate a second, or the time of each if that is slower than one a second."""
    return f"{1 / rate:,.0f} s each" if 0 < rate < 1 else f"{rate:,.0f}/s"


def read_metrics(folder: str | Path) -> list[dict[str, float]]:
    """The lines of a run's `metrics.jsonl`, each with `step`, `wall_time` (s) and its scalars.

    An incomplete last line, left by a machine that stopped during a write, is ignored.
    A missing file or any other damaged line raises `RunError`.
    """
    path = Path(folder) / METRICS
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{path}: cannot read metrics: {error}") from error
    entries = []
    for number, line in enumerate(lines, start=1):
        if not line.endswith("\n"):
            break
        try:
            entry = json.loads(line)
            entry["step"] = int(entry["step"])
        except (ValueError, TypeError, KeyError) as error:
            expected = "expected a JSON object with a 'step'"
            raise RunError(f"{path}: line {number}: {expected}, found {line[:60]!r}") from error
        entries.append(entry)
    return entries


def read_columns(folder: str | Path) -> dict[str, list[float]]:
    """`read_metrics` by name, NaN where a line has no such number."""
    lines = read_metrics(folder)
    names = dict.fromkeys(name for line in lines for name in line)
    return {name: [line.get(name, math.nan) for line in lines] for name in names}


def _append(path: Path, line: str) -> None:
    """Append one line; a write that fails midway is undone."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND)
        try:
            length = os.fstat(descriptor).st_size
            data = line.encode()
            try:
                while data:
                    data = data[os.write(descriptor, data) :]
            except BaseException:
                os.ftruncate(descriptor, length)
                raise
        finally:
            os.close(descriptor)
    except OSError as error:
        raise RunError(f"{path}: cannot append metrics: {error}") from error


def _make_folder(root: Path, name: str) -> Path:
    folder, number = root / name, 1
    while folder.exists():
        number += 1
        folder = root / f"{name}-{number}"
    folder.mkdir(parents=True)
    return folder
