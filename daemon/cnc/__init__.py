"""The connection to the CNC: session, macro block, audited writes, interlocks, limits."""
