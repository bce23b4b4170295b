"""Colours that all pictures share."""

DOOR_COLORS = {"push": "#4477aa", "pull": "#ee9955", "slide": "#66aa88"}
"""Colour of each kind of door, which is also a direction in which one can be tried."""
