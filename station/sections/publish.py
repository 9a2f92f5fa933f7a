"""Table of the site file on what is sent away: files to targets, a hook and a heartbeat for each epoch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from station.section_types import Positive, Section
from station.sections.results import Target

Remote = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.+@ -]*:")]
Content = Literal["page", "areas", "events", "digest", "geotiff", "levels", "epochs"]


class PublishTarget(Section):
    """Where files are sent (a remote of rclone, `name:path`, or a folder that exists), and which."""

    to: Remote | Path
    what: Annotated[tuple[Content, ...], Field(min_length=1)] = ("page", "areas", "events", "digest")
    bandwidth_kbit_s: Positive | None = None
    daily_mb: Positive | None = None


class PublishSection(Section):
    """What `station publish` does after each epoch; `heartbeat` is the name of a credential with its URL."""

    heartbeat: Target | None = None
    hook: tuple[str, ...] = ()
    hook_limit_s: Annotated[float, Field(gt=0, le=3600)] = 60.0
    target: tuple[PublishTarget, ...] = ()

    @model_validator(mode="after")
    def _targets_differ(self) -> PublishSection:
        places = [str(target.to) for target in self.target]
        if len(set(places)) < len(places):
            raise ValueError("two [[publish.target]] have the same to: put what they send into one")
        return self
