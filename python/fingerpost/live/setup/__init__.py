"""Set-up on the page: views, table, hand, the operator's aim, and the rig file; nothing is typed.

`asked` is what a page may ask for; `offers` what may become a view, with pictures of it; `table`
finds the references and judges the rig (`advise`, `doctor`); `hand` looks for the hand; `aim`
learns the operator's habit; `dialogue` goes through these steps, in the order that the page asks.
"""
