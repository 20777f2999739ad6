"""Temperatures from registers: Modbus TCP and RTU."""
