"""Reads measurements from files: recordings, frequency responses, impact tests, accelerations."""
