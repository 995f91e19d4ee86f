"""Run folders: configuration, metrics and progress of one command, safe against interruption."""

import contextlib
import dataclasses
import json
import math
import os
import time
from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Self

import rich.progress
from rich.console import Console

from vertiwm_jax import atomic, config, hosts, trackers
from vertiwm_jax.atomic import WriteError
from vertiwm_jax.errors import UserError
from vertiwm_jax.trackers import Events

METRICS = "metrics.jsonl"
SECONDS_BETWEEN_LINES = 15.0
"""Of progress, where there is no terminal."""


class RunError(UserError):
    """A run folder that cannot be read or written; the message names the path."""


@contextlib.contextmanager
def _refused(action: str) -> Iterator[None]:
    """What the system refuses raises `RunError`; action: what could not be done, and where."""
    try:
        yield
    except OSError as error:
        raise RunError(f"{action}: {error}") from error


class Run:
    """One run's folder: `config.yaml`, `metrics.jsonl`, TensorBoard events, and what commands add.

    `outermost` is the folder to resume: that of the run that this one is a `part` of, or its own.
    """

    def __init__(
        self,
        folder: Path,
        settings: Any,
        step: int | None = None,
        project: str | None = None,
        outermost: Path | None = None,
    ) -> None:
        """Begins a run, or goes on with the one in `folder` from its checkpoint at `step`.

        Then later metrics are dropped, and the dataclass `settings` replaces the earlier ones.
        A folder that cannot be made or written, or whose metrics are missing or damaged, raises
        `RunError`. project: of Weights & Biases, which gets the metrics of the first host too;
        `TrackingError` where it refuses.
        """
        self.folder, self.outermost, self.project = folder, outermost or folder, project
        known = [] if step is None else read_metrics(folder)
        kept = [json.dumps(entry) + "\n" for entry in known if entry["step"] <= (step or 0)]
        with _refused(f"{folder}: cannot keep a run there"):
            folder.mkdir(exist_ok=True)
            atomic.write(folder / METRICS, "".join(kept))
            atomic.write(folder / "config.yaml", config.dump(settings))
            self._events = Events(folder)
            if step is not None:
                self._events.restart(step + 1)
        self._tracker: Any = None
        if project and hosts.is_first():
            self._tracker = trackers.begin(project, folder, self.outermost, settings)

    @staticmethod
    def expect(settings: Any, project: str | None = None) -> None:
        """Raises as `begin` where no run can begin or go on; for before what takes long."""
        if project:
            trackers.check(project)
        if hosts.is_first():
            try:
                atomic.expect_folder(settings.resume or settings.runs)
            except WriteError as error:
                action = "go on with" if settings.resume else "start"
                folder = settings.resume or settings.runs
                raise RunError(f"{folder}: cannot {action} a run there: {error}") from error

    @classmethod
    def create(cls, root: str | Path, name: str, settings: Any, project: str | None = None) -> Self:
        """Begins a run in a new folder `root/name-YYYYmmdd-HHMMSS`; raises as `Run`."""
        first = Path(root) / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
        folder, number = first, 1
        with _refused(f"{root}: cannot start a run there"):
            while folder.exists():
                number += 1
                folder = Path(f"{first}-{number}")
            folder.mkdir(parents=True)
        return cls(folder, settings, project=project)

    @classmethod
    def begin(cls, settings: Any, name: str, step: int = 0, project: str | None = None) -> Self:
        """Create a run with these settings, or continue the one that they name from `step`.

        Of several hosts only the first keeps a folder; the others have temporary ones.
        settings: a dataclass with `runs`, the folder of runs, and `resume`, that of the run to
        continue, or None. Raises as `Run`, before a folder is made if the package `wandb` is
        missing.
        """
        cls.expect(settings, project)
        kept = dataclasses.replace(settings, resume=None)
        if settings.resume is None:
            return cls.create(hosts.own(settings.runs), name, kept, project)
        return cls(hosts.own_copy(settings.resume), kept, step, project)

    def part(self, name: str, step: int, settings: Any) -> "Run":
        """A run in the folder `name` inside this one: begun, or continued from `step`."""
        folder = self.folder / name
        begun = (folder / METRICS).is_file()
        return Run(folder, settings, step if begun else None, self.project, self.outermost)

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Record scalars at `step` in `metrics.jsonl` and for TensorBoard.

        Both are on disk, or at least with the operating system, on return. A write that fails
        (a full disk) leaves the earlier lines whole and raises `RunError`.
        """
        now = time.time()
        values = {name: float(value) for name, value in metrics.items()}
        path = self.folder / METRICS
        _append(path, json.dumps({"step": int(step), "wall_time": round(now, 3), **values}) + "\n")
        with _refused(f"{self.folder}: cannot write TensorBoard events"):
            self._events.log(int(step), now, values)
        if self._tracker:
            self._tracker.log(values, step=int(step))

    def close(self) -> None:
        """Close the TensorBoard file; `metrics.jsonl` is always complete."""
        if self._tracker:
            self._tracker.finish()
        with _refused(f"{self.folder}: cannot write TensorBoard events"):
            self._events.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        # After a failed write the file cannot be flushed either: the first error is the news.
        with contextlib.suppress(RunError) if error else contextlib.nullcontext():
            self.close()


class Progress:
    """A progress bar with rate and time left on a terminal; elsewhere a plain line now and then.

    Use as a context manager and call `advance`.
    """

    def __init__(self, total: int, description: str) -> None:
        self._total, self._description, self._done = total, description, 0
        self._console = Console()
        self._bar = rich.progress.Progress(
            rich.progress.TextColumn("{task.description}"),
            rich.progress.BarColumn(),
            rich.progress.TextColumn("{task.fields[standing]}"),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task(description, total=total, standing=f"0/{total:,}")

    def __enter__(self) -> Self:
        self._start = self._last = time.monotonic()
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def advance(self, amount: int = 1, note: str = "") -> None:
        """Count `amount` more units as done; `note` is shown beside rate and time left."""
        self._done += amount
        now = time.monotonic()
        rate = self._done / max(now - self._start, 1e-9)
        pace = f"{1 / rate:,.0f} s each" if 0 < rate < 1 else f"{rate:,.0f}/s"
        left = max(self._total - self._done, 0) / max(rate, 1e-9)
        standing = f"{self._done:,}/{self._total:,}  {pace}  {left:,.0f} s left  {note}".rstrip()
        self._bar.update(self._task, advance=amount, standing=standing)
        due = now - self._last >= SECONDS_BETWEEN_LINES or self._done >= self._total
        if due and not self._console.is_terminal:
            self._last = now
            print(f"{self._description} {standing}", flush=True)


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
    with _refused(f"{path}: cannot append metrics"):
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND)
        length, data = os.fstat(descriptor).st_size, line.encode()
        try:
            while data:
                data = data[os.write(descriptor, data) :]
        except BaseException:
            os.ftruncate(descriptor, length)
            raise
        finally:
            os.close(descriptor)
