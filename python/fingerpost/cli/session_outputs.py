"""Outputs of all commands that follow a hand: published fixes, a recording, the command log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from fingerpost.cli.publishing import Publishing
from fingerpost.cli.recorder import open_recorder

if TYPE_CHECKING:
    from fingerpost.capture import Frame, Loss, Source
    from fingerpost.config import Rig
    from fingerpost.guidance import ArmRecording, GuidedArm
    from fingerpost.pipeline import Step
    from fingerpost.recording.session import Recorder
    from fingerpost.robot import CommandRecord
    from fingerpost.robot.guard import RecordCallback

    Frames = Iterator[Sequence[Frame | Loss | None]]


class SessionOutputs:
    """Publishes fixes, records the session and logs the commands to an arm.

    Parameters
    ----------
    publish
        URLs to publish fixes to.
    record
        File of the recording; None records nothing.
    images
        Format of recorded images, as for `open_recorder`.
    log
        The log of commands from `open_log`; None for no log.
    """

    def __init__(
        self,
        *,
        publish: Sequence[str],
        record: Path | None,
        images: str | None,
        log: RecordCallback | None = None,
    ) -> None:
        self._publish, self._record, self._images = publish, record, images
        self._log = log
        self._published: Publishing | None = None
        self._recorder: Recorder | None = None
        self._of_arm: ArmRecording | None = None

    @property
    def is_idle(self) -> bool:
        """Whether nothing is to be published or recorded."""
        return not self._publish and self._record is None

    @contextmanager
    def opened(
        self,
        rig: Rig,
        sources: Sequence[Source],
        *,
        is_live: bool,
        arm: GuidedArm | None = None,
    ) -> Iterator[None]:
        """Publish and record during the block.

        Parameters
        ----------
        rig, sources
            The rig, and the open sources of its views.
        is_live
            Whether times are the machine's clock's; then slow receivers are not waited for.
        arm
            The guided arm, if any: its state and its commands are recorded.

        Raises
        ------
        FingerpostError
            A recording that exists or cannot be written, or a missing extra.
        """
        with ExitStack() as stack:
            if self._publish:
                self._published = Publishing(stack, self._publish, rig, is_live=is_live)
            if self._record is not None:
                recorder = open_recorder(self._record, rig, sources, self._images, is_live=is_live)
                self._recorder = stack.enter_context(recorder)
                if arm is not None:
                    from fingerpost.guidance import ArmRecording

                    self._of_arm = ArmRecording(arm, self._recorder)
            yield

    def watch(self, frames: Frames) -> Frames:
        """Return the frames of all views unchanged, and record them."""
        return frames if self._recorder is None else self._recorder.watch(frames)

    def take(self, step: Step) -> None:
        """Publish and record a step."""
        if self._published is not None:
            self._published.take(step)
        if self._recorder is not None:
            self._recorder.take(step)
        if self._of_arm is not None:
            self._of_arm.take(step)

    def on_record(self, record: CommandRecord) -> None:
        """Record a command, first in the log, which stops the arm if it fails."""
        if self._log is not None:
            self._log(record)
        if self._of_arm is not None:
            self._of_arm.on_record(record)

    def notes(self) -> list[str]:
        """Return the final remarks for people."""
        taken = (self._published, self._recorder)
        return [note for one in taken if one is not None for note in one.notes()]
