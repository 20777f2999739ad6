"""Pure mathematics of Toolpoint: no input or output, no clock, no logging."""
