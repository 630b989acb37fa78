"""The operator's page: shows the indicated point in a browser, at camera rate.

The main loop runs unchanged (`operate`). Its results are passed to a separate process (`page`,
`process`), which serves one page and one WebSocket (`web`, `client`). A binary message carries one
moment: the pictures and the scene drawn over them, which therefore always belong to one instant
(`moment`, `scene`, `composer`). Older moments are dropped for the newest, so a slow page delays
nothing. Recordings are played at their own pace, forwards and backwards (`player`, `reel`).

Only pages of this server that were opened with its token are served (`web.Guard`). Requests that
are too slow, too many or invalid are refused with one line (`patience`, `commands`).
"""

from fingerpost.live.desk import OPERATOR_TIMEOUT_S, GuidingDesk
from fingerpost.live.inline import InlineView, show
from fingerpost.live.operate import operate
from fingerpost.live.page import Page
from fingerpost.live.setup.dialogue import set_up

__all__ = ["OPERATOR_TIMEOUT_S", "GuidingDesk", "InlineView", "Page", "operate", "set_up", "show"]
