"""A page on which one draws a map and a policy moves through it, in any browser.

`web/` holds the simulator and the networks once more, as plain JavaScript modules. `tests/play`
compares what they compute with the program's own.
"""
