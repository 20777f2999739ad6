"""The programs on the NC side: their text, filled in for one machine, and the sheet of their commissioning."""
