"""Stability of milling: cutting coefficients, lobes, spindle speed, chatter, roughness.

SI inside (N, m, s, Hz) except where a name says otherwise; angles in radians. Axis index 0 is the
feed direction (or the machine's X before it is turned), 1 is normal to it, right-handed seen
against the tool; the spindle turns clockwise seen from above (M3).
"""
