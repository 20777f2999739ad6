"""Descriptions of a machine as data: spindle, materials, published bearings, milling cases."""
