"""Writes metrics as TensorBoard events."""

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

# tensorboardX imports PyTorch wherever it is installed, for tensors that we do not have: this would
# take two seconds of every start and half a gigabyte. Where it is there already, it stays.
_IMPORTED = "torch" in sys.modules
if not _IMPORTED:
    cast(dict[str, Any], sys.modules)["torch"] = None
try:
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import (  # generated without types
        Event,  # pyright: ignore[reportAttributeAccessIssue]
        SessionLog,  # pyright: ignore[reportAttributeAccessIssue]
    )
    from tensorboardX.summary import scalar
finally:
    if not _IMPORTED:
        del sys.modules["torch"]


class Events:
    """A new file of events in a run's folder `events`. What the system refuses raises `OSError`."""

    def __init__(self, folder: Path) -> None:
        # Written in this thread: a background writer would lose a full disk's error, then hang.
        self._writer = EventsWriter(str(folder / "events"), filename_suffix=f".{time.time_ns()}")

    def restart(self, step: int) -> None:
        """Makes TensorBoard hide what earlier files hold from this step on."""
        restart = SessionLog(status=SessionLog.START)
        self._writer.write_event(Event(wall_time=time.time(), step=step, session_log=restart))

    def log(self, step: int, wall_time: float, values: Mapping[str, float]) -> None:
        """Records scalars; they have been handed to the operating system on return."""
        for name, value in values.items():
            event = Event(wall_time=wall_time, step=step, summary=scalar(name, value))
            self._writer.write_event(event)
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()
