"""Descriptions of recordings and measurement campaigns: column maps, programme, index."""
