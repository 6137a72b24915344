"""The process and its machine: devices, signals, and programs that are compiled once."""
