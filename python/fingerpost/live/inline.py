"""The operator's page inside a notebook: `fingerpost.show(rig)` as the last line of a cell.

The same page is served by the same process, in a frame. Browsers send no strict cookies from a
frame of another site, so its address has the token in its path; the server permits framing of such
a page.
"""

from __future__ import annotations

import atexit
import html
import logging
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

from fingerpost.config import Rig
from fingerpost.errors import FingerpostError
from fingerpost.live.operate import operate
from fingerpost.live.page import Page
from fingerpost.operators import Operator

_log = logging.getLogger(__name__)

_LEAST_HEIGHT_PX = 200


class InlineView:
    """A rig's run on a page inside a notebook, until it is closed or the kernel ends.

    Parameters
    ----------
    rig
        At least two views.
    title
        Name of the rig on the page.
    operator
        Person whose habit of pointing is subtracted from the points.
    height_px
        Height of the frame [px], at least 200.

    Raises
    ------
    MissingExtraError
        The extra `page` is not installed.

    Attributes
    ----------
    address
        Address of the frame's content; it can also be opened in a browser.
    """

    def __init__(
        self, rig: Rig, title: str, operator: Operator | None = None, *, height_px: int = 720
    ) -> None:
        self._height_px = max(height_px, _LEAST_HEIGHT_PX)
        self._page = Page("127.0.0.1", 0)
        self.address = self._page.framed_address
        self._thread = threading.Thread(
            target=self._operate, args=(rig, title, operator), name="fingerpost view", daemon=True
        )
        self._thread.start()
        atexit.register(self.close)

    def _operate(self, rig: Rig, title: str, operator: Operator | None) -> None:
        try:
            operate(self._page, rig, title, operator)
        except FingerpostError as error:
            if not self._page.is_closed:
                _log.error("%s", error)

    def close(self) -> None:
        """End the run and its page; closing twice does nothing."""
        atexit.unregister(self.close)
        self._page.close()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _repr_html_(self) -> str:
        """Return the frame, as the representation of a cell's value."""
        address = html.escape(self.address, quote=True)
        return (
            f'<iframe src="{address}" title="fingerpost" width="100%" '
            f'height="{self._height_px}" style="border:0;border-radius:10px" '
            'allow="fullscreen"></iframe>'
        )


def show(
    rig: Rig | str | Path, operator: Operator | None = None, *, height_px: int = 720
) -> InlineView:
    """Show a rig's run inside a notebook, on the operator's page.

    Parameters
    ----------
    rig
        A rig, or its file; cameras are shown at their rate, recordings at their own pace.
    operator
        Person whose habit of pointing is subtracted from the points.
    height_px
        Height of the frame [px], at least 200.

    Returns
    -------
    InlineView
        Displayed by a notebook as the value of a cell. `close` ends it, and so does the end of the
        kernel. The browser must run on the kernel's machine.

    Raises
    ------
    InvalidInputError
        Not a rig file.
    MissingExtraError
        The extra `page` is not installed: `pip install 'fingerpost[page]'`.
    """
    if isinstance(rig, Rig):
        return InlineView(rig, "rig", operator, height_px=height_px)
    return InlineView(Rig.load(rig), Path(rig).name, operator, height_px=height_px)
