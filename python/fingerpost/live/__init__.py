"""The operator's page: see where you point, at camera rate, in a browser.

The main loop goes on as ever (`operate`); its results are handed to a process of its own (`page`,
`process`), which serves one page and one WebSocket (`web`, `client`). A binary message carries one
moment: what is drawn over the pictures and the pictures themselves, which therefore always belong
to one instant (`moment`, `scene`, `composer`). The newest moment wins, and a page that does not
keep up costs nothing. Recordings are played at their own pace, to and fro (`player`, `reel`).

Only pages of this server that were opened with its token are answered (`web.Guard`); whoever asks
too slowly, too much or for nonsense is refused in one line (`patience`, `commands`).
"""

from fingerpost.live.desk import OPERATOR_TIMEOUT_S, GuidingDesk
from fingerpost.live.inline import InlineView, show
from fingerpost.live.operate import operate
from fingerpost.live.page import Page
from fingerpost.live.setup.dialogue import set_up

__all__ = ["OPERATOR_TIMEOUT_S", "GuidingDesk", "InlineView", "Page", "operate", "set_up", "show"]
