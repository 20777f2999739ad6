"""Opcua."""
