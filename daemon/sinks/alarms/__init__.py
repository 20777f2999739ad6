"""Alarms: what is wrong at the machine goes to people by webhook or mail, from the process that sends the history."""
