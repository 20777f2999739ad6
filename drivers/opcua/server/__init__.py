"""Serves tags and methods over OPC UA: address space, channel, session, subscriptions; who may is its user's matter."""
