"""Set-up on the page: views, table, hand, the operator's aim, and the rig file, without typing.

`asked` defines the page's commands; `offers` lists the sources that may become views, with
pictures; `table` detects the references and assesses the rig (`advise`, `doctor`); `hand` searches
for the hand; `aim` calibrates the operator's habit; `wording` replaces words of the rig file in
messages; `dialogue` executes these steps in the order that the page requests.
"""
