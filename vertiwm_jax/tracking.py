"""Sends the metrics of a run to Weights & Biases, if a project is named."""

import dataclasses
import json
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vertiwm_jax.errors import UserError

if TYPE_CHECKING:
    from wandb import Run as Tracker


class TrackingError(UserError):
    """A run that cannot be tracked; the message says what is missing."""


def check(project: str) -> None:
    """`TrackingError` where the package is missing."""
    if find_spec("wandb") is None:
        raise TrackingError(
            f"wandb: expected the package for project {project!r}, found none; pip install wandb"
        )


def begin(project: str, folder: Path, outermost: Path, settings: Any) -> "Tracker":
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
