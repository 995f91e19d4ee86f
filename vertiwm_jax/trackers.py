"""Sends the metrics of a run to TensorBoard, and to Weights & Biases if a project is named."""

import dataclasses
import json
import sys
import time
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

from vertiwm_jax.errors import UserError

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


class Events(EventsWriter):
    """A new file of events in a run's folder `events`. What the system refuses raises `OSError`."""

    def __init__(self, folder: Path) -> None:
        # Written in this thread: a background writer would lose a full disk's error, then hang.
        super().__init__(str(folder / "events"), filename_suffix=f".{time.time_ns()}")

    def restart(self, step: int) -> None:
        """Makes TensorBoard hide what earlier files hold from this step on."""
        restart = SessionLog(status=SessionLog.START)
        self.write_event(Event(wall_time=time.time(), step=step, session_log=restart))

    def log(self, step: int, wall_time: float, values: Mapping[str, float]) -> None:
        """Records scalars; they have been handed to the operating system on return."""
        for name, value in values.items():
            self.write_event(Event(wall_time=wall_time, step=step, summary=scalar(name, value)))
        self.flush()


class TrackingError(UserError):
    """A run that cannot be tracked; the message says what is missing."""


def check(project: str) -> None:
    """`TrackingError` where the package is missing."""
    if find_spec("wandb") is None:
        raise TrackingError(
            f"wandb: expected the package for project {project!r}, found none; pip install wandb"
        )


def begin(project: str, folder: Path, outermost: Path, settings: Any) -> Any:
    """A run of that project, continued if it exists; its files lie in `folder`.

    outermost: folder of the run that this is a part of, or its own; its name names the group.
    settings: a dataclass. `TrackingError` where Weights & Biases refuses.
    """
    import wandb

    names = dict.fromkeys((outermost.name, folder.name))
    try:
        return wandb.init(
            project=project,
            dir=folder,
            id="-".join(names),
            name=folder.name,
            group=outermost.name,
            config=json.loads(json.dumps(dataclasses.asdict(settings), default=str)),
            resume="allow",
            reinit="create_new",
            settings=wandb.Settings(console="off", silent=True),
        )
    except wandb.Error as error:
        reason = str(error).splitlines()[0]
        mend = "WANDB_MODE=offline needs neither an account nor a network"
        raise TrackingError(
            f"wandb: cannot begin a run of {project!r}: {reason}; {mend}"
        ) from error
