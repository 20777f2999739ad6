"""Histories of many simulated machines, sent into real sinks and counted there: what a plant can rely on.

Three processes beside the one that counts: the machines record with the daemon's own store writer, the senders run
the daemon's own sinks, and where the way leads over MQTT the plant's store takes what arrives. Each may be killed.
"""
